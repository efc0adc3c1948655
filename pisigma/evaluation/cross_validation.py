"""Cross-validation of a recipe on measured data: every row is judged by a model that never saw it."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from pisigma.errors import RecipeError
from pisigma.evaluation.pose_statistics import PoseErrors, corrected_errors, nominal_errors
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds
from pisigma.training.recipe import MeasuredData, Recipe
from pisigma.training.run import train_recipe


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors of held-out rows, each in its own fold.

    Attributes:
        folds: number of folds.
        nominal: with base and tool fitted to the training rows of the fold.
        corrected: with the correction learned on them too.
    """

    folds: int
    nominal: PoseErrors
    corrected: PoseErrors

    def in_file_units(self) -> dict[str, object]:
        """The figures in mm and deg."""
        return {
            "folds": self.folds,
            "nominal": self.nominal.in_file_units(),
            "corrected": self.corrected.in_file_units(),
        }

    @property
    def verdict(self) -> str:
        """Whether the correction helps, in one sentence."""
        nominal, corrected = self.nominal.in_file_units(), self.corrected.in_file_units()
        share = corrected["rms_mm"] / nominal["rms_mm"]
        position = f"{nominal['rms_mm']:.3f} to {corrected['rms_mm']:.3f} mm RMS"
        if share < 0.95:
            return f"On held-out rows the correction lowers the position error from {position}."
        if share <= 1.05:
            return f"On held-out rows the correction does not change the position error ({position}): do not use it."
        return f"On held-out rows the correction raises the position error from {position}: do not use it."


def cross_validate(
    recipe: Recipe, measurements: Measurements, on_fold: Callable[[int, int], None] = lambda done, folds: None
) -> CrossValidation:
    """Train the recipe once per fold, on the other folds, and judge it on the fold.

    Args:
        recipe: for measured data.
        measurements: its rows.
        on_fold: called before every fold with the number of folds done and of all.

    Raises:
        RecipeError: the recipe simulates its data.
        MeasurementError: there are fewer different joint vectors than folds.
    """
    if not isinstance(recipe.data, MeasuredData):
        raise RecipeError(f"recipe '{recipe.name}' simulates its data; it has held-out rows of its own.")
    nominal = torch.full((2, measurements.rows), torch.nan, dtype=torch.float64)
    corrected = nominal.clone()
    folds = k_folds(measurements, recipe.data.folds, recipe.data.seed)
    for done, (train, test) in enumerate(folds):
        on_fold(done, len(folds))
        model = train_recipe(recipe, measurements.select(train)).model
        unseen = measurements.select(test)
        for store, errors in ((nominal, nominal_errors(model, unseen)), (corrected, corrected_errors(model, unseen))):
            store[0, test] = errors.position
            if errors.rotation is not None:
                store[1, test] = errors.rotation
    rotated = measurements.rotation is not None
    before, after = (PoseErrors(store[0], store[1] if rotated else None) for store in (nominal, corrected))
    return CrossValidation(len(folds), before, after)
