"""`pisigma train`: from a recipe to a model folder."""

import shlex
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from pisigma.judging.cross_validation import CrossValidation
    from pisigma.measurement.dataset import Measurements
    from pisigma.recipes.recipe import Recipe


def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML), such as training/kiro3.yaml.")],
    data: Annotated[
        Path | None, typer.Option(help="Measured data (CSV), for recipes that ask for it.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Model folder to write [runs/NAME].")] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on from where an interrupted training of this folder stopped."),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Train the model of a recipe and write it as a model folder with card and figures."""
    started = time.perf_counter()
    from pisigma.recipes.geometric_recipe import GeometricRecipe
    from pisigma.recipes.hybrid_recipe import HybridRecipe
    from pisigma.recipes.recipe_kinds import read_any_recipe

    stated = read_any_recipe(recipe)
    if isinstance(stated, GeometricRecipe):
        from pisigma.cli.train_geometric import train_geometric

        return train_geometric(stated, recipe, data, out, resume, as_json)
    if isinstance(stated, HybridRecipe):
        from pisigma.cli.train_hybrid import train_hybrid

        return train_hybrid(stated, recipe, data, out, resume, as_json)
    import shutil

    from pisigma.cli.output import print_json
    from pisigma.model.folder.model_folder import save_model
    from pisigma.model.folder.staging import check_replaceable, staged_folder
    from pisigma.recipes.recipe import recipe_hash
    from pisigma.recipes.recipe_data import load_measurements
    from pisigma.reporting.card import write_card
    from pisigma.reporting.training_report import report_training
    from pisigma.workflow.run import RunOptions, train_recipe

    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    measurements, test = load_measurements(stated, data).split_sets()
    checkpoints = folder.parent / f".{folder.name}.training"
    run = train_recipe(stated, measurements, RunOptions(checkpoints, resume, True, recipe_hash(recipe)))
    report = report_training(stated, run, _cross_validate(stated, measurements), test)
    command = shlex.join(["pisigma", "train", recipe.as_posix(), *(["--data", data.name] if data else [])])
    with staged_folder(folder) as scratch:
        save_model(replace(run.model, metrics=report), scratch)
        write_card(stated, command, run, report, scratch)
    shutil.rmtree(checkpoints, ignore_errors=True)
    result = {"model": str(folder), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        print_json(result)
    else:
        _print_report(result)


def _cross_validate(recipe: "Recipe", measurements: "Measurements") -> "CrossValidation | None":
    """Cross-validate a recipe for measured data; a simulated one has held-out rows of its own."""
    from rich.console import Console

    from pisigma.judging.cross_validation import cross_validate
    from pisigma.recipes.recipe import MeasuredData

    if not isinstance(recipe.data, MeasuredData):
        return None
    with Console(stderr=True).status("cross-validation") as status:
        return cross_validate(
            recipe,
            measurements,
            lambda done, folds: status.update(f"cross-validation: fold {done + 1} of {folds}"),
        )


def _print_report(result: dict[str, Any]) -> None:
    from pisigma.cli.output import print_table
    from pisigma.reporting.tables import joint_rows, pose_rows

    columns = [
        f"{when}\n{name}" for when in ("before", "after") for name in ("average", "deviat.", "maximum")
    ]
    print_table("absolute joint errors", ("joint", "unit", "rows", *columns), joint_rows(result["joints"]))
    if "cross_validation" in result:
        figures = result["cross_validation"]
        title = f"pose errors of held-out rows, {figures['folds']}-fold cross-validation"
        print_table(title, *pose_rows({name: figures[name] for name in ("nominal", "corrected")}))
        typer.echo(result["verdict"])
    if "test" in result:
        test = result["test"]
        title = f"pose errors of the {test['rows']} rows of the set 'test', which were kept aside"
        print_table(title, *pose_rows({name: test[name] for name in ("nominal", "corrected")}))
    rows = result["rows"]
    reason = f" ({rows['rule']})" if rows["left_out"] else ""
    typer.echo(f"{rows['used']} rows used, {rows['left_out']} left out{reason}.")
    typer.echo(f"Model written to {result['model']} in {result['seconds']:.1f} s; read its README.md.")
