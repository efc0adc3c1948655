"""Train the model of a recipe: typed settings in, a typed result out that writes itself as a model folder."""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

from pisigma.files.errors import RecipeError
from pisigma.files.progress import Progress, stage
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.reporting.cards import CardTexts, write_training_card
from pisigma.validation.held_out.calibration_summary import summarise
from pisigma.validation.held_out.calibration_validation import errors_under, judge, learning_curve, validate
from pisigma.validation.held_out.pose_statistics import compare_on
from pisigma.validation.held_out.training_summary import (
    ComparisonFigures,
    TrainingRun,
    TrainingSummary,
    summarise_training,
)
from pisigma.validation.held_out.validation_figures import ValidationFigures
from pisigma.workflow.calibrate import Calibration, compose
from pisigma.workflow.recipes.data import RecipeData, load_data
from pisigma.workflow.recipes.reader import read_recipe, recipe_hash
from pisigma.workflow.recipes.recipe import GeometricRecipe, HybridRecipe, InverseRecipe, Recipe
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.training import TrainSettings
from pisigma.workflow.train_networks import cross_validate, train_networks


@dataclass(frozen=True, eq=False)
class InverseTraining(AbstractModelResult):
    """Networks on nominal joint values, trained and judged.

    Attributes:
        model: what `pisigma.load` would read, with all figures as its metrics.
        recipe: what was trained.
        run: what training gave: history, pairs, joint errors.
        summary: all figures.
        seconds: time it took [s].
    """

    model: CalibratedModel
    recipe: InverseRecipe
    run: TrainingRun
    summary: TrainingSummary
    seconds: float = 0.0

    @property
    def validation(self) -> ComparisonFigures | None:
        """Errors of rows under trainings without them, for measured data; None for simulated ones."""
        return self.summary.cross_validation

    @property
    def test(self) -> ComparisonFigures | None:
        """Errors of the rows that the data mark as test; None without such rows."""
        return self.summary.test

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to heed, a sentence each."""
        rows = self.summary.rows
        return (f"{rows.left_out} rows were left out of the training: {rows.rule}.",) if rows.rule else ()

    def _describe(self, model: CalibratedModel, summary: TrainingSummary, folder: Path) -> None:
        texts = CardTexts(self.recipe.description, self.recipe.not_validated)
        write_training_card(model.name, texts, self.run, summary, folder)


Training = InverseTraining | Calibration


def train(
    recipe: Recipe | str | os.PathLike[str],
    data: Measurements | str | os.PathLike[str] | None = None,
    settings: TrainSettings = TrainSettings(),
    progress: Progress = lambda what: None,
) -> Training:
    """Train the model of a recipe, and judge it on rows that it did not see.

    Args:
        recipe: of whatever kind, or its file.
        data: measured data or a CSV file of them, for a recipe that asks for them.
        settings: see `TrainSettings`.
        progress: called with what is being done.

    Returns:
        `InverseTraining` for a recipe of inverse calibration, else a `Calibration`.

    Raises:
        RecipeError: the recipe cannot be read, or has no use for data or settings.
        RobotError: its robot cannot be used.
        MeasurementError: the data cannot be used.
        IdentificationError: the data do not determine what is asked for.
        TrainingError: the training diverged, or there is no checkpoint of this recipe and data to resume.
        OutputError: checkpoints cannot be written.
    """
    started = time.perf_counter()
    sha256 = ""
    if isinstance(recipe, str | os.PathLike):
        path = recipe
        recipe, sha256 = read_recipe(path), recipe_hash(path)
    loaded = load_data(recipe, data)
    result: Training
    if isinstance(recipe, GeometricRecipe):
        result = _train_geometric(recipe, sha256, loaded, settings)
    elif isinstance(recipe, HybridRecipe):
        result = _train_hybrid(recipe, sha256, loaded, settings, progress)
    else:
        result = _train_inverse(recipe, sha256, loaded, settings, progress)
    return replace(result, seconds=time.perf_counter() - started)


def _call(recipe: Recipe) -> str:
    """The call that gives such a training again, for the card."""
    return f"pisigma.train({recipe.name!r})"


def _refuse_resume(recipe: Recipe) -> None:
    raise RecipeError(
        f"recipe '{recipe.name}': a recipe of kind {recipe.kind} has no use for --resume; leave it out."
    )


def _train_geometric(
    recipe: GeometricRecipe, sha256: str, data: RecipeData, settings: TrainSettings
) -> Calibration:
    if settings.resume:
        _refuse_resume(recipe)
    rows, held_out = data.simulations[0]
    calibrator = recipe.calibration.calibrator(data.robot)
    result = calibrator.fit(rows)
    errors = errors_under(result, held_out).figures
    summary = summarise(result).having(
        command=_call(recipe),
        redundant_sets=tuple(tuple(members) for members in result.pairwise.sets),
        no_effect=tuple(result.pairwise.no_effect),
        pairwise_parameters=len(result.pairwise.kept),
        held_out=ValidationFigures(rows=held_out.rows, geometric=errors),
        paper=recipe.model_dump(mode="json")["paper"] or None,
    )
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose(calibrator, result, rows, summary, texts, recipe=(recipe.name, sha256))


def _train_hybrid(
    recipe: HybridRecipe,
    sha256: str,
    data: RecipeData,
    settings: TrainSettings,
    progress: Progress,
) -> Calibration:
    if settings.resume:
        _refuse_resume(recipe)
    rows = data.training
    measured = data.folds is not None
    judged, splits = data.splits()
    calibrator = recipe.calibrator(data.robot)
    started = time.perf_counter()
    result = calibrator.fit(rows, stage(progress, "calibration"))
    seconds = time.perf_counter() - started
    validation = validate(calibrator, judged, splits, stage(progress, "held-out rows"), settings.jobs)
    test = None if data.test is None else judge(calibrator, result, rows, data.test)
    curve = None
    if (stated := recipe.learning_curve) is not None:
        of_curve = stage(progress, "learning curve")
        sizes, seed, jobs = stated.rows, stated.seed, settings.jobs
        curve = learning_curve(calibrator, judged, splits, sizes, seed, of_curve, validation, jobs)
    summary = summarise(result).having(
        command=_call(recipe),
        rows=rows.rows,
        fit_seconds=round(seconds, 3),
        cross_validation=validation.figures() if measured else None,
        test=None if test is None else test.figures(),
        held_out=None if measured else validation.figures(splits),
        learning_curve=curve,
    )
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose(
        calibrator,
        result,
        rows,
        summary,
        texts,
        validation,
        test,
        held_out=rows if measured else None,
        recipe=(recipe.name, sha256),
    )


def _train_inverse(
    recipe: InverseRecipe,
    sha256: str,
    data: RecipeData,
    settings: TrainSettings,
    progress: Progress,
) -> InverseTraining:
    run = train_networks(recipe, data, settings, sha256)
    validation = None if data.folds is None else cross_validate(recipe, data, progress, settings.jobs)
    test = None
    if data.test is not None:
        test = ComparisonFigures.of(compare_on(run.model, data.test), rows=data.test.rows)
    summary = summarise_training(run, recipe.paper, validation, test).having(command=_call(recipe))
    model = replace(run.model, metrics=summary.to_json())
    return InverseTraining(model, recipe, run, summary)
