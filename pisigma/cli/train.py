"""`pisigma train`: from a recipe to a model folder."""

import json
import shlex
import time
from pathlib import Path
from typing import Annotated, Any

import typer


def train(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML), such as training/kiro3.yaml.")],
    data: Annotated[Path | None, typer.Option(help="Measured data (CSV), for recipes that ask for it.")] = None,
    out: Annotated[Path | None, typer.Option(help="Model folder to write [runs/NAME].")] = None,
    resume: Annotated[bool, typer.Option(help="Go on from where an interrupted training of this folder stopped.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Train the model of a recipe and write it as a model folder with card and figures."""
    started = time.perf_counter()
    from pisigma.correction.model_folder import check_replaceable, save_model, staged_folder
    from pisigma.evaluation.card import write_card
    from pisigma.evaluation.training_report import report_training
    from pisigma.training.checkpoints import checkpoint_folder, discard_checkpoints
    from pisigma.training.recipe import MeasuredData, read_recipe, recipe_hash
    from pisigma.training.run import RunOptions, load_measurements, train_recipe

    stated = read_recipe(recipe)
    folder = out or Path("runs") / stated.name
    check_replaceable(folder)
    measurements = load_measurements(stated, data)
    checkpoints = checkpoint_folder(folder)
    run = train_recipe(stated, measurements, RunOptions(checkpoints, resume, True, recipe_hash(recipe)))
    validation = _cross_validate(stated, measurements) if isinstance(stated.data, MeasuredData) else None
    report = report_training(stated, run, validation)
    run.model.metrics.update(report)
    command = shlex.join(["pisigma", "train", recipe.as_posix(), *(["--data", data.name] if data else [])])
    with staged_folder(folder) as scratch:
        save_model(run.model, scratch)
        write_card(stated, command, run, report, scratch)
    discard_checkpoints(checkpoints)
    result = {"model": str(folder), "seconds": round(time.perf_counter() - started, 3), **report}
    if as_json:
        typer.echo(json.dumps(result))
    else:
        _print_report(result)


def _cross_validate(recipe: Any, measurements: Any) -> Any:
    from rich.console import Console

    from pisigma.evaluation.cross_validation import cross_validate

    with Console(stderr=True).status("cross-validation") as status:
        return cross_validate(
            recipe, measurements, lambda done, folds: status.update(f"cross-validation: fold {done + 1} of {folds}")
        )


def _print_report(result: dict[str, Any]) -> None:
    from pisigma.cli.output import print_table

    rows = []
    for joint in result["joints"]:
        for part in ("training", "held_out", "paper"):
            if part in joint:
                unit = next(iter(joint[part]["before"])).rsplit("_", 1)[1]
                figures = [f"{value:.4f}" for when in ("before", "after") for value in joint[part][when].values()]
                rows.append((f"{joint['name']} [{unit}]".replace("[", "\\["), part.replace("_", "-"), *figures))
    columns = [f"{when}\n{name}" for when in ("before", "after") for name in ("average", "deviat.", "maximum")]
    print_table("absolute joint errors", ("joint", "rows", *columns), rows)
    if "cross_validation" in result:
        figures = result["cross_validation"]
        names = [name for name in figures if name != "folds"]
        table = [(name, *(f"{value:.3f}" for value in figures[name].values())) for name in names]
        title = f"pose errors on held-out rows, {figures['folds']}-fold"
        print_table(title, ("model", *(key.replace("_", " ") for key in figures[names[0]])), table)
        typer.echo(result["verdict"])
    left_out = result["rows"]["left_out"]
    reason = f" ({result['rows']['rule']})" if left_out else ""
    typer.echo(f"{result['rows']['used']} rows used, {left_out} left out{reason}.")
    typer.echo(f"Model written to {result['model']} in {result['seconds']:.1f} s; read its README.md.")
