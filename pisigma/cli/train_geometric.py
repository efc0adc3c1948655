"""`pisigma train` with a recipe of the geometric calibrator."""

import shlex
import textwrap
import time
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pisigma.identification.result import CalibrationResult
    from pisigma.recipes.geometric_recipe import GeometricRecipe

_WIDTH = 44
"""Columns of a list of parameters."""


def train_geometric(
    stated: "GeometricRecipe", recipe: Path, data: Path | None, out: Path | None, resume: bool, as_json: bool
) -> None:
    """Calibrate the simulated robot of a recipe and write the model folder.

    Args:
        stated: the recipe.
        recipe: its file.
        data: not for this kind of recipe.
        out: model folder to write; None: runs/NAME.
        resume: not for this kind of recipe.
        as_json: print one JSON object.

    Raises:
        RecipeError: the recipe does not fit, or options were given that it has no use for.
    """
    started = time.perf_counter()
    from pisigma.cli.calibrate import print_calibration
    from pisigma.cli.output import print_json
    from pisigma.errors import RecipeError
    from pisigma.judging.calibration_validation import errors_under
    from pisigma.model.folder.model_folder import save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.model.geometric_model import model_of_calibration
    from pisigma.recipes.recipe import recipe_hash
    from pisigma.recipes.recipe_data import simulate_held_out, simulate_training
    from pisigma.reporting.calibration_card import write_calibration_card
    from pisigma.reporting.calibration_report import report_calibration
    from pisigma.robot.description import Robot

    if data is not None or resume:
        given = "--data" if data is not None else "--resume"
        raise RecipeError(f"{recipe}: a recipe of kind {stated.kind} has no use for {given}; leave it out.")
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    rows, held_out = simulate_training(stated), simulate_held_out(stated)
    result = stated.calibrate(rows)
    report = {
        **report_calibration(result),
        **_redundancy(result),
        "held_out": {"rows": held_out.rows, **errors_under(result, held_out).in_file_units()},
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
        write_calibration_card(model, result, rows, None, report, texts, scratch)
    finished = {
        "model": str(folder),
        "seconds": round(time.perf_counter() - started, 3),
        **report,
    }
    if as_json:
        print_json(finished)
        return
    print_redundancy(finished)
    print_calibration(finished)


def print_redundancy(result: dict[str, Any]) -> None:
    """Print what is redundant beside the paper's, and how the calibration converged."""
    from pisigma.cli.output import print_table

    paper = result.get("paper", {})
    rows = _sets_side_by_side(result["redundant_sets"], paper.get("redundant_sets", []))
    rows += _wrapped("no effect", _in_braces(result["no_effect"]), _in_braces(paper.get("no_effect", [])))
    for label, name, key, form in (
        ("parameters left by pairs", "pairwise_parameters", "pairwise_parameters", "{}"),
        ("rank", "rank", "rank", "{}"),
        ("iterations", "iterations", "iterations_to_converge", "{}"),
        ("RMSE after [mm]", "rmse_mm", "rmse_after_mm", "{:.2e}"),
    ):
        ours = result[name][-1] if isinstance(result[name], list) else result[name]
        rows.append((label, form.format(ours), form.format(paper[key]) if key in paper else ""))
    print_table("redundancy and convergence", ("what", "pisigma", "paper"), rows)


def _sets_side_by_side(ours: list[list[str]], papers: list[list[str]]) -> list[tuple[str, str, str]]:
    """A line per set, equal sets on one line."""
    rows: list[tuple[str, str, str]] = []
    left = list(papers)
    for members in ours:
        same = next((other for other in left if set(other) == set(members)), None)
        if same is not None:
            left.remove(same)
        rows += _wrapped("", _in_braces(members), _in_braces(same or []))
    for members in left:
        rows += _wrapped("", "", _in_braces(members))
    return [("redundant sets", *row[1:]) if number == 0 else row for number, row in enumerate(rows)]


def _in_braces(names: list[str]) -> str:
    return f"{{{', '.join(names)}}}" if names else ""


def _wrapped(label: str, *cells: str) -> list[tuple[str, str, str]]:
    """One row of a table as lines of bounded width."""
    columns = [[label], *(textwrap.wrap(cell, _WIDTH) or [""] for cell in cells)]
    return [(line[0], line[1], line[2]) for line in zip_longest(*columns, fillvalue="")]


def _redundancy(result: "CalibrationResult") -> dict[str, Any]:
    """The paper's figures: pairs found by correlation, parameters left, exact rank."""
    pairwise = result.pairwise
    return {
        "redundant_sets": [list(members) for members in pairwise.sets],
        "no_effect": list(pairwise.no_effect),
        "pairwise_parameters": len(pairwise.kept),
    }
