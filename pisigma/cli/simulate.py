"""`pisigma simulate`: the simulated measurements of a recipe as a file."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.output import print_json


def simulate(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML) with simulated data.")],
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Write the held-out rows instead of the training rows.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write the simulated measurements of a recipe as a CSV file."""
    from pisigma.recipes.data import simulate_held_out, simulate_training
    from pisigma.recipes.reader import read_recipe
    from pisigma.robot import Robot

    stated = read_recipe(recipe)
    rows = simulate_held_out(stated) if held_out else simulate_training(stated)
    rows.write_csv(out, Robot.load(stated.robot))
    if as_json:
        print_json({"file": str(out), "rows": rows.rows, "sha256": rows.content_hash()})
    else:
        typer.echo(f"{rows.rows} measurements written to {out}.")
