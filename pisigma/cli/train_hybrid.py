"""`pisigma train` with a recipe of the hybrid calibrator."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from pisigma.cli.output import print_json
    from pisigma.cli.progress import progress_of
    from pisigma.errors import RecipeError
    from pisigma.judging.calibration_validation import judge, validate
    from pisigma.judging.held_out_rows import HELD_OUT_CSV, held_out_csv, held_out_section
    from pisigma.model.folder.model_folder import save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.model.geometric_model import model_of_hybrid
    from pisigma.recipes.recipe import MeasuredData, recipe_hash
    from pisigma.reporting.calibration_card import write_calibration_card
    from pisigma.robot.description import Robot

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
    report: dict[str, Any] = {"rows": rows.rows, "fit_seconds": round(fitting, 3)}
    report |= _report(stated, result, (validation, kept_aside), everything, parts)
    nominal = Robot.load(stated.robot)
    held_out = held_out_csv(validation, rows, nominal) if isinstance(stated.data, MeasuredData) else None
    if held_out is not None:
        report |= held_out_section(held_out, rows)
    model = model_of_hybrid(stated.name, nominal, result, rows, (stated.name, recipe_hash(recipe)))
    command = shlex.join(["pisigma", "train", recipe.as_posix(), *(["--data", data.name] if data else [])])
    texts = {"description": stated.description, "command": command, "not_validated": stated.not_validated}
    with staged_folder(folder) as scratch:
        save_model(replace(model, metrics=report), scratch)
        write_calibration_card(model, result, rows, validation, report, texts, scratch)
        if held_out is not None:
            (scratch / HELD_OUT_CSV).write_text(held_out, encoding="utf-8", newline="\n")
    finished = {"model": str(folder), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
    else:
        print_calibration(finished)


def _rows(recipe: "HybridRecipe", data: Path | None) -> "Given":
    """Rows to calibrate with, all rows to judge on, those of the set `test`, and how the rows are parted."""
    from pisigma.measurement.splits import k_folds
    from pisigma.recipes.recipe import MeasuredData
    from pisigma.recipes.recipe_data import load_measurements, simulate_repeats, split_sets

    rows, test = split_sets(load_measurements(recipe, data))
    if isinstance(recipe.data, MeasuredData):
        return rows, rows, test, k_folds(rows, recipe.data.folds, recipe.data.seed)
    everything, parts = simulate_repeats(recipe)
    return rows, everything, None, parts


def _report(
    recipe: "HybridRecipe",
    result: Any,
    judged: tuple[Any, Any],
    everything: "Measurements",
    parts: "tuple[TrainTest, ...]",
) -> dict[str, Any]:
    """Figures of the calibration, of held-out rows and of the learning curve."""
    from pisigma.cli.progress import progress_of
    from pisigma.judging.learning_curve import learning_curve
    from pisigma.recipes.recipe import MeasuredData
    from pisigma.reporting.calibration_report import report_calibration

    validation, test = judged
    if isinstance(recipe.data, MeasuredData):
        report = report_calibration(result, validation, test)
    else:
        report = {
            **report_calibration(result),
            "held_out": validation.in_file_units() | validation.means(parts),
        }
    if recipe.learning_curve is not None:
        stated = recipe.learning_curve
        with progress_of("learning curve") as tell:
            points = learning_curve(
                recipe.calibrator(), everything, parts, stated.rows, stated.seed, tell, validation
            )
        report["learning_curve"] = [point.in_file_units() for point in points]
    return report
