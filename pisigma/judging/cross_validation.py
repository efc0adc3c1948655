"""Cross-validation of a trained correction: every row is judged by a model that did not see it."""

from dataclasses import dataclass

from pisigma.judging.pose_statistics import Comparison

LEVEL = 0.05
"""Relative change of an error that is taken for none."""


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors of held-out rows, each in its own fold.

    Attributes:
        folds: number of folds.
        comparison: nominal with base and tool fitted to the training rows of the fold, and corrected with the
            correction learned on them too.
    """

    folds: int
    comparison: Comparison

    @property
    def verdict(self) -> str:
        """Whether the correction helps, in a sentence."""
        figures = self.comparison.in_file_units()
        nominal, corrected = figures["nominal"], figures["corrected"]
        findings, harm, help_, larger = [], False, False, False
        for name, quantity, unit in (("position", "rms_mm", "mm"), ("orientation", "rms_deg", "deg")):
            if quantity in nominal:
                before, after = nominal[quantity], corrected[quantity]
                change = "lowers" if after < before * (1 - LEVEL) else "does not change"
                change = "raises" if after > before * (1 + LEVEL) else change
                harm, help_ = harm or change == "raises", help_ or change == "lowers"
                rise = _rise(nominal[f"max_{unit}"], corrected[f"max_{unit}"], unit)
                rise = rise and f", {'and' if change == 'raises' else 'but'} {rise}"
                larger = larger or bool(rise)
                findings.append(f"{change} the {name} error ({before:.3f} to {after:.3f} {unit} RMS{rise})")
        advice = "; use it with care" if harm or larger else ""
        advice = advice if help_ else "; do not use it"
        return f"On held-out rows the correction {' and '.join(findings)}{advice}."


def _rise(before: float, after: float, unit: str) -> str:
    """Say that the largest error rises, by however little; nothing where it does not."""
    texts = f"{before:.3f}", f"{after:.3f}"
    rises = after > before and texts[0] != texts[1]
    return f"the largest rises from {texts[0]} to {texts[1]} {unit}" if rises else ""
