"""`pisigma train` with a recipe of a robot that touches jigs."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pisigma.recipes.jig_recipe import JigRecipe


def train_jigs(
    stated: "JigRecipe", recipe: Path, data: Path | None, out: Path | None, resume: bool, as_json: bool
) -> None:
    """Calibrate the simulated robot of a recipe with touches and write the model folder.

    Raises:
        RecipeError: the recipe does not fit, or options were given that it has no use for.
    """
    started = time.perf_counter()
    from rich.console import Console

    from pisigma.cli.output import print_json
    from pisigma.errors import RecipeError
    from pisigma.model.folder.model_folder import save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.model.geometric_model import model_of_calibration
    from pisigma.recipes.recipe import recipe_hash
    from pisigma.robot.description import Robot
    from pisigma.studies.jig_card import write_jig_card
    from pisigma.studies.jig_report import DEFAULT, report_jigs, run_jigs

    if data is not None or resume:
        given = "--data" if data is not None else "--resume"
        raise RecipeError(f"{recipe}: a recipe of kind {stated.kind} has no use for {given}; leave it out.")
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    with Console(stderr=True).status("touching") as status:
        run = run_jigs(stated, status.update)
    report = report_jigs(run)
    result = run.calibrations[DEFAULT].result
    assert result is not None
    model = model_of_calibration(
        stated.name,
        Robot.load(stated.robot),
        result,
        run.measurements,
        (stated.name, recipe_hash(recipe)),
    )
    texts = {
        "description": stated.description,
        "command": shlex.join(["pisigma", "train", recipe.as_posix()]),
        "not_validated": stated.not_validated,
    }
    with staged_folder(folder) as scratch:
        save_model(replace(model, metrics=report), scratch)
        write_jig_card(model, run, report, texts, scratch)
    finished = {"model": str(folder), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(finished)
    else:
        print_jigs(finished)


def print_jigs(result: dict[str, object]) -> None:
    """Print the tables, what the figures in them mean, and where the model is."""
    import typer

    from pisigma.cli.output import print_table
    from pisigma.studies.jig_tables import all_tables

    for table in all_tables(result):
        print_table(table.title, table.columns, table.rows)
    definitions = result["definitions"]
    assert isinstance(definitions, list)
    for sentence in definitions:
        typer.echo(f"- {sentence}.")
    typer.echo(f"Model written to {result['model']} in {result['seconds']:.1f} s; read its README.md.")
