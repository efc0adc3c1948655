"""`pisigma train` with a recipe of the hybrid calibrator."""

import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pisigma.judging.calibration_summary import CalibrationSummary
    from pisigma.measurement.dataset import Measurements
    from pisigma.measurement.splits import TrainTest
    from pisigma.recipes.hybrid_recipe import HybridRecipe

    Given = tuple[Measurements, Measurements, Measurements | None, tuple[TrainTest, ...]]


def train_hybrid(
    stated: "HybridRecipe", recipe: Path, data: Path | None, out: Path | None, resume: bool, as_json: bool
) -> None:
    """Calibrate the robot of a recipe, judge it on held-out rows and write the model folder.

    Args:
        stated: the recipe.
        recipe: its file.
        data: measured data, where the recipe asks for it.
        out: model folder to write; None: runs/NAME.
        resume: not for this kind of recipe.
        as_json: print one JSON object.

    Raises:
        RecipeError: the recipe does not fit, or options were given that it has no use for.
    """
    started = time.perf_counter()
    from pisigma.cli.calibrate import print_calibration
    from pisigma.cli.output import print_json, progress_of
    from pisigma.errors import RecipeError
    from pisigma.judging.calibration_validation import judge, validate
    from pisigma.model.folder.staging import check_replaceable
    from pisigma.recipes.recipe import MeasuredData, recipe_hash
    from pisigma.reporting.calibration_card import CardTexts
    from pisigma.robot.description import Robot
    from pisigma.workflow.calibrate import compose

    if resume:
        raise RecipeError(f"{recipe}: a recipe of kind {stated.kind} has no use for --resume; leave it out.")
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    calibrator = stated.calibrator()
    rows, everything, test, parts = _rows(stated, data)
    fitting = time.perf_counter()
    with progress_of("calibration") as tell:
        result = calibrator.fit(rows, tell)
    fitting = time.perf_counter() - fitting
    with progress_of("held-out rows") as tell:
        validation = validate(calibrator, everything, parts, tell)
    kept_aside = None if test is None else judge(calibrator, result, rows, test)
    summary = _summary(stated, result, (validation, kept_aside), everything, parts).having(
        rows=rows.rows, fit_seconds=round(fitting, 3)
    )
    held_out = rows if isinstance(stated.data, MeasuredData) else None
    texts = CardTexts(stated.description, stated.not_validated)
    hashed = (stated.name, recipe_hash(recipe))
    nominal = Robot.load(stated.robot)
    calibration = compose(
        nominal, result, rows, summary, texts, validation, kept_aside, held_out, recipe=hashed
    )
    command = shlex.join(["pisigma", "train", recipe.as_posix(), *(["--data", data.name] if data else [])])
    calibration.save(folder, stated.name, command)
    seconds = time.perf_counter() - started
    if as_json:
        print_json({"model": str(folder), "seconds": round(seconds, 3), **calibration.summary.to_json()})
    else:
        print_calibration(calibration.summary, folder, seconds)


def _rows(recipe: "HybridRecipe", data: Path | None) -> "Given":
    """Rows to calibrate with, all rows to judge on, those of the set `test`, and how the rows are parted."""
    from pisigma.measurement.splits import k_folds
    from pisigma.recipes.recipe import MeasuredData
    from pisigma.recipes.recipe_data import load_measurements, simulate_repeats

    rows, test = load_measurements(recipe, data).split_sets()
    if isinstance(recipe.data, MeasuredData):
        return rows, rows, test, k_folds(rows, recipe.data.folds, recipe.data.seed)
    everything, parts = simulate_repeats(recipe)
    return rows, everything, None, parts


def _summary(
    recipe: "HybridRecipe",
    result: Any,
    judged: tuple[Any, Any],
    everything: "Measurements",
    parts: "tuple[TrainTest, ...]",
) -> "CalibrationSummary":
    """Figures of the calibration, of held-out rows and of the learning curve."""
    from pisigma.cli.output import progress_of
    from pisigma.judging.calibration_summary import summarise
    from pisigma.judging.calibration_validation import learning_curve
    from pisigma.recipes.recipe import MeasuredData

    validation, test = judged
    summary = summarise(result)
    if isinstance(recipe.data, MeasuredData):
        summary = summary.having(
            cross_validation=validation.figures(), test=None if test is None else test.figures()
        )
    else:
        summary = summary.having(held_out=validation.figures(parts))
    if recipe.learning_curve is not None:
        stated = recipe.learning_curve
        with progress_of("learning curve") as tell:
            points = learning_curve(
                recipe.calibrator(), everything, parts, stated.rows, stated.seed, tell, validation
            )
        summary = summary.having(learning_curve=tuple(point.figures() for point in points))
    return summary
