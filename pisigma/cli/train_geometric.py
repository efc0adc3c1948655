"""`pisigma train` with a recipe of the geometric calibrator."""

import shlex
import textwrap
import time
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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
    from pisigma.judging.calibration_summary import summarise
    from pisigma.judging.calibration_validation import errors_under
    from pisigma.judging.validation_figures import ErrorFigures, ValidationFigures
    from pisigma.model.folder.staging import check_replaceable
    from pisigma.recipes.recipe import recipe_hash
    from pisigma.recipes.recipe_data import simulate_held_out, simulate_training
    from pisigma.reporting.calibration_card import CardTexts
    from pisigma.robot.description import Robot
    from pisigma.workflow.calibrate import compose

    if data is not None or resume:
        given = "--data" if data is not None else "--resume"
        raise RecipeError(f"{recipe}: a recipe of kind {stated.kind} has no use for {given}; leave it out.")
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    rows, held_out = simulate_training(stated), simulate_held_out(stated)
    result = stated.calibrate(rows)
    errors = ErrorFigures.model_validate(errors_under(result, held_out).in_file_units())
    summary = summarise(result).having(
        redundant_sets=tuple(tuple(members) for members in result.pairwise.sets),
        no_effect=tuple(result.pairwise.no_effect),
        pairwise_parameters=len(result.pairwise.kept),
        held_out=ValidationFigures(rows=held_out.rows, geometric=errors),
        paper=stated.model_dump(mode="json")["paper"] or None,
    )
    texts = CardTexts(stated.description, stated.not_validated)
    hashed = (stated.name, recipe_hash(recipe))
    calibration = compose(Robot.load(stated.robot), result, rows, summary, texts, recipe=hashed)
    calibration.save(folder, stated.name, shlex.join(["pisigma", "train", recipe.as_posix()]))
    seconds = time.perf_counter() - started
    finished = {"model": str(folder), "seconds": round(seconds, 3), **summary.to_json()}
    if as_json:
        print_json(finished)
        return
    print_redundancy(finished)
    print_calibration(summary, folder, seconds)


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
