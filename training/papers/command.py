"""The command `python training/papers`: generate the page of the recipes, or run one of them and store its result."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from jig_recipe import JIGS, read_jig_recipe
from page import PAGE, page_text
from pictures import draw_pictures
from pisigma.files.errors import PisigmaError
from pisigma.files.output_file import write_atomically
from pisigma.robot.description import Robot
from published import read_published
from stored_results import read_results

FOLDER = Path(__file__).resolve().parent.parent
"""The folder of the recipes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: Arguments of the command line; None: those of the process.

    Returns:
        The exit status: 0 done, 2 a file is missing or invalid.
    """
    chosen = _parser().parse_args(arguments)
    try:
        if chosen.command == "run":
            from recipe_runs import run_recipe  # imports lightning, which takes seconds

            run_recipe(chosen.folder, chosen.name, chosen.data, chosen.out)
        elif chosen.command == "touches":
            write_touches(chosen.folder, chosen.out)
        else:
            write_page(chosen.folder)
    except PisigmaError as problem:
        print(f"pisigma: {problem}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python training/papers",
        description="Write README.md and figures/ of the recipes from their stored results, or run a command:",
    )
    parser.add_argument("--folder", type=Path, default=FOLDER, help="folder of the recipes")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    run = commands.add_parser("run", help="run a recipe and store its result")
    run.add_argument("name", help="name of the recipe, such as kiro3 or jigs")
    run.add_argument("--data", type=Path, metavar="CSV", help="measured data, if the recipe needs them")
    run.add_argument("--out", type=Path, metavar="DIR", help="model folder to write (default: runs/NAME)")
    touches = commands.add_parser("touches", help="write the simulated touches of the recipe jigs")
    touches.add_argument("--out", type=Path, metavar="CSV", required=True, help="file to write")
    return parser


def write_page(folder: Path) -> None:
    """Write the page and its pictures.

    Args:
        folder: The folder of the recipes.

    Raises:
        PisigmaError: A file is missing or invalid; the page is unchanged.
    """
    text = page_text(folder)
    draw_pictures(folder, read_published(folder), read_results(folder))
    write_atomically(folder / PAGE, text)


def write_touches(folder: Path, out: Path) -> None:
    """Write the touches of the first seed on both jigs as a measurement file.

    Args:
        folder: The folder of the recipes.
        out: The CSV file to write.

    Raises:
        PisigmaError: The recipe is invalid, or the file cannot be written.
    """
    recipe = read_jig_recipe(folder / JIGS)
    rows = recipe.measure(recipe.draw_touches(0), 0)
    rows.write_csv(out, Robot.load(recipe.robot))
    print(f"{rows.rows} measurements written to {out}.")
