"""Cross-validation of a recipe on measured data: every row is judged by a model that never saw it."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from pisigma.errors import RecipeError
from pisigma.judging.pose_statistics import Comparison, PoseErrors, compare_on
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds
from pisigma.recipes.recipe import MeasuredData, Recipe
from pisigma.workflow.run import train_recipe

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

    def in_file_units(self) -> dict[str, object]:
        """The figures in mm and deg."""
        rows = {"folds": self.folds, "rows_not_predicted": self.comparison.not_predicted}
        return {**rows, **self.comparison.in_file_units()}

    @property
    def verdict(self) -> str:
        """Whether the correction helps, in a sentence."""
        figures = self.comparison.in_file_units()
        nominal, corrected = figures["nominal"], figures["corrected"]
        findings, harm, help_, careful = [], False, False, False
        for name, quantity, unit in (("position", "rms_mm", "mm"), ("orientation", "rms_deg", "deg")):
            if quantity in nominal:
                before, after = nominal[quantity], corrected[quantity]
                change = "lowers" if after < before * (1 - LEVEL) else "does not change"
                change = "raises" if after > before * (1 + LEVEL) else change
                harm, help_ = harm or change == "raises", help_ or change == "lowers"
                rise = _rise(nominal[f"max_{unit}"], corrected[f"max_{unit}"], unit)
                rise = rise and f", {'and' if change == 'raises' else 'but'} {rise}"
                careful = careful or bool(rise)
                findings.append(f"{change} the {name} error ({before:.3f} to {after:.3f} {unit} RMS{rise})")
        advice = "; use it with care" if harm or careful else ""
        advice = advice if help_ else "; do not use it"
        return f"On held-out rows the correction {' and '.join(findings)}{advice}."


def _rise(before: float, after: float, unit: str) -> str:
    """Say that the largest error rises, by however little; nothing where it does not."""
    texts = f"{before:.3f}", f"{after:.3f}"
    rises = after > before and texts[0] != texts[1]
    return f"the largest rises from {texts[0]} to {texts[1]} {unit}" if rises else ""


def cross_validate(
    recipe: Recipe, measurements: Measurements, on_fold: Callable[[int, int], None] = lambda done, folds: None
) -> CrossValidation:
    """Train the recipe once per fold, on the other folds, and judge it on the fold.

    Args:
        recipe: for measured data.
        measurements: its rows to train on; every one is held out once.
        on_fold: called before every fold with the number of folds done and of all.

    Raises:
        RecipeError: the recipe simulates its data.
        MeasurementError: there are fewer different joint vectors than folds.
    """
    if not isinstance(recipe.data, MeasuredData):
        raise RecipeError(f"recipe '{recipe.name}' simulates its data; it has held-out rows of its own.")
    not_predicted = 0
    nominal = torch.full((2, measurements.rows), torch.nan, dtype=torch.float64)
    corrected = nominal.clone()
    folds = k_folds(measurements, recipe.data.folds, recipe.data.seed)
    for done, (train, test) in enumerate(folds):
        on_fold(done, len(folds))
        model = train_recipe(recipe, measurements.select(train)).model
        comparison = compare_on(model, measurements.select(test))
        not_predicted += comparison.not_predicted
        for store, errors in ((nominal, comparison.nominal), (corrected, comparison.corrected)):
            store[0, test] = errors.position
            if errors.rotation is not None:
                store[1, test] = errors.rotation
    rotated = measurements.rotation is not None
    before, after = (PoseErrors(store[0], store[1] if rotated else None) for store in (nominal, corrected))
    return CrossValidation(len(folds), Comparison(before, after, not_predicted))
