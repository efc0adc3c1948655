"""What a hybrid calibration gave beyond the geometric one, as figures and sentences."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from pisigma.hybrid.result import HybridResult, LearnedPart
from pisigma.reporting.tables import figure_text

TRIAL_COLUMNS = ("tried", "unknowns", "log evidence", "left-out error", "seconds", "kept")


def report_hybrid(result: HybridResult) -> dict[str, Any]:
    """Everything that is said of the learned part, in millimetres and degrees; what is not known is None.

    `left_out` of a trial is the RMS of training rows that were left out of its fit, in units of the geometric
    calibration's.
    """
    trials = [asdict(trial) for trial in result.trials]
    for trial in trials:
        trial["log_evidence"] = _or_none(trial["log_evidence"])
        trial["seconds"] = round(trial["seconds"], 3)
    report: dict[str, Any] = {"verdict": result.verdict, "learned": None, "trials": trials}
    if result.learned is not None:
        report["learned"] = _learned(result, result.learned)
    return report


def _learned(result: HybridResult, learned: LearnedPart) -> dict[str, Any]:
    units = {noise.sensor: noise.unit for noise in result.geometric.noise}
    return {
        "features": [chosen.describe() for chosen in learned.correction.features],
        "orders": list(learned.correction.orders),
        "unknowns": learned.unknowns,
        "effective_parameters": learned.effective,
        "linearisations": learned.rounds,
        "noise": [_noise(sensor, sigma, units[sensor]) for sensor, sigma in learned.noise.items()],
        "variance_widening": result.uncertainty.prior_scale,
        "fades_over_deg": math.degrees(learned.coverage.fade),
    }


def _noise(sensor: str, sigma: float, unit: str) -> dict[str, Any]:
    name, factor = {
        "m": ("sigma_mm", 1e3),
        "rad": ("sigma_deg", math.degrees(1.0)),
        "given": ("factor_on_given_sigma", 1.0),
    }[unit]
    return {"sensor": sensor, name: sigma * factor}


def trial_rows(report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Rows of text of what was tried, in order; see `TRIAL_COLUMNS`.

    Args:
        report: from `report_hybrid`.
    """
    return [
        (
            trial["name"],
            str(trial["unknowns"]),
            "" if trial["log_evidence"] is None else f"{trial['log_evidence']:.1f}",
            f"{trial['left_out']:.3f}",
            f"{trial['seconds']:.1f}",
            "yes" if trial["kept"] else "no",
        )
        for trial in report["trials"]
    ]


def learned_lines(report: Mapping[str, Any]) -> list[str]:
    """What was learned, in sentences.

    Args:
        report: from `report_hybrid`.
    """
    lines, learned = [report["verdict"]], report["learned"]
    if learned is not None:
        lines.append(
            f"Geometry and correction have {learned['unknowns']} unknowns, of which the data tell "
            f"{learned['effective_parameters']:.0f}; beyond the measured joint values the correction fades to nothing "
            f"over {learned['fades_over_deg']:.0f} deg."
        )
    return lines


def coverage_line(figures: Mapping[str, Any]) -> str:
    """How often held-out rows were where they were expected, in a sentence.

    Args:
        figures: with "coverage", from `CalibrationValidation.in_file_units`.
    """
    return (
        f"{100 * figures['coverage']:.1f} % of the held-out coordinates are within the 95 % intervals that the hybrid "
        f"predicts (RMS of a predicted position error: {figure_text(figures['predicted_rms_mm'])} mm)."
    )


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
