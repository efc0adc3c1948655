"""`pisigma simulate`: write the simulated measurements of a recipe."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson
from pisigma.cli.output import print_json, print_line

if TYPE_CHECKING:
    from pisigma.workflow.recipes.recipe import Recipe


def simulate(
    recipe: Annotated[Path, typer.Argument(help="Recipe (YAML) with simulated data.")],
    out: Annotated[Path | None, typer.Option(help="CSV file to write.")] = None,
    images: Annotated[
        Path | None,
        typer.Option(
            help="Folder for rendered images with joints.csv, camera.yaml and board.yaml, for a recipe with a camera."
        ),
    ] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Write the held-out rows instead of the training rows.")
    ] = False,
    at: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of joint values to measure at, or a cell, whose newest plan is used. [default: as in the "
            "recipe]"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the simulated measurements of a recipe as a CSV file, or the images of its camera."""
    from pisigma.files.errors import RecipeError
    from pisigma.files.output_file import check_output
    from pisigma.lifetime.cell.layout import newest_plan
    from pisigma.robot.robot_file import robot_file
    from pisigma.workflow.recipes.data import simulate as simulate_recipe
    from pisigma.workflow.recipes.data import simulate_at
    from pisigma.workflow.recipes.reader import read_recipe

    read = read_recipe(recipe)
    if (out is None) == (images is None):
        raise RecipeError(
            "expected either --out (a CSV file of measurements) or --images (a folder)", option="--out"
        )
    if at is not None and (held_out or images is not None):
        raise RecipeError(
            "--at cannot be combined with --held-out or --images", option="--at", remedy="omit it"
        )
    if images is not None:
        _write_images(read, images, as_json)
        return
    assert out is not None
    check_output(out, inputs=(recipe, robot_file(read.robot), at))
    if at is not None:
        robot, rows = simulate_at(read, newest_plan(at))
    else:
        data = simulate_recipe(read)
        robot, rows = data.robot, data.simulations[0][1 if held_out else 0]
    rows.write_csv(out, robot)
    if as_json:
        print_json({"file": str(out), "rows": rows.rows, "sha256": rows.content_hash()})
    else:
        print_line(f"{rows.rows} measurements written to {out}.")


def _write_images(recipe: "Recipe", folder: Path, as_json: bool) -> None:
    from pisigma.workflow.recipes.data import write_recipe_images

    count = write_recipe_images(recipe, folder)
    if as_json:
        print_json({"folder": str(folder), "images": count})
    else:
        print_line(f"{count} images, joints.csv, camera.yaml and board.yaml written to {folder}.")
