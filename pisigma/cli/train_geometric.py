"""`pisigma train` with a recipe of the geometric calibrator."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pisigma.identification.result import CalibrationResult


def train_geometric(recipe: Path, data: Path | None, out: Path | None, resume: bool, as_json: bool) -> None:
    """Calibrate the simulated robot of a recipe and write the model folder.

    Raises:
        RecipeError: the recipe does not fit, or options were given that it has no use for.
    """
    started = time.perf_counter()
    from pisigma.cli.calibrate import print_calibration
    from pisigma.cli.output import print_json
    from pisigma.correction.geometric_model import model_of_calibration
    from pisigma.correction.model_folder import save_model
    from pisigma.correction.staging import check_replaceable, staged_folder
    from pisigma.errors import RecipeError
    from pisigma.evaluation.calibration_card import write_calibration_card
    from pisigma.evaluation.calibration_report import report_calibration
    from pisigma.evaluation.geometric_validation import errors_under
    from pisigma.robot.description import Robot
    from pisigma.training.geometric_recipe import read_geometric_recipe
    from pisigma.training.recipe import recipe_hash

    stated = read_geometric_recipe(recipe)
    if data is not None or resume:
        given = "--data" if data is not None else "--resume"
        raise RecipeError(f"{recipe}: a recipe of kind {stated.kind} has no use for {given}; leave it out.")
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    rows, held_out = stated.simulate()
    result = stated.calibrate(rows)
    report = {
        **report_calibration(result, None),
        **_redundancy(result),
        "held_out": errors_under(result, held_out).in_file_units(),
    }
    if stated.paper:
        report["paper"] = stated.model_dump()["paper"]
    model = model_of_calibration(
        stated.name, Robot.load(stated.robot), result, rows, (stated.name, recipe_hash(recipe))
    )
    texts = {
        "description": stated.description,
        "command": shlex.join(["pisigma", "train", recipe.as_posix()]),
        "not_validated": stated.not_validated,
    }
    with staged_folder(folder) as scratch:
        save_model(replace(model, metrics=report), scratch)
        write_calibration_card(model, result, None, report, texts, scratch)
    finished = {"model": str(folder), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
        return
    print_redundancy(finished)
    print_calibration(finished)


def print_redundancy(result: dict[str, Any]) -> None:
    """Print what is redundant beside the paper's, and how the calibration converged."""
    from pisigma.cli.output import print_table

    paper = result.get("paper", {})
    rows = [
        (name.replace("_", " "), _short(result[name]), _short(paper.get(name, "")))
        for name in ("redundant_sets", "no_effect", "pairwise_parameters", "rank")
    ]
    rows.append(("iterations", str(result["iterations"]), str(paper.get("iterations_to_converge", ""))))
    rows.append(
        ("RMSE after [mm]", f"{result['rmse_mm'][-1]:.2e}", f"{paper.get('rmse_after_mm', float('nan')):.2e}")
    )
    print_table("redundancy and convergence", ("what", "pisigma", "paper"), rows)


def _redundancy(result: "CalibrationResult") -> dict[str, Any]:
    """The paper's figures: pairs found by correlation, parameters left, exact rank."""
    pairwise = result.pairwise
    return {
        "redundant_sets": [list(members) for members in pairwise.sets],
        "no_effect": list(pairwise.no_effect),
        "pairwise_parameters": len(pairwise.kept),
    }


def _short(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "; ".join(
            _short(item) if isinstance(item, list | tuple) else str(item) for item in value
        ).replace("; ", " ")
    return str(value)
