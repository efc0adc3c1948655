"""`pisigma simulate`: the simulated measurements of a recipe as a file."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.output import print_json, print_line


def simulate(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML) with simulated data.")],
    out: Annotated[Path, typer.Option(help="CSV file to write.")],
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Write the held-out rows instead of the training rows.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Write the simulated measurements of a recipe as a CSV file."""
    from pisigma.files.output_file import check_output
    from pisigma.recipes.data import simulate as simulate_recipe
    from pisigma.recipes.reader import read_recipe
    from pisigma.robot.robot_file import robot_file

    read = read_recipe(recipe)
    check_output(out, inputs=(recipe, robot_file(read.robot)))
    data = simulate_recipe(read)
    rows = data.simulations[0][1 if held_out else 0]
    rows.write_csv(out, data.robot)
    if as_json:
        print_json({"file": str(out), "rows": rows.rows, "sha256": rows.content_hash()})
    else:
        print_line(f"{rows.rows} measurements written to {out}.")
