"""`python -m pisigma.studies.papers training`: make the page of the recipes, or run one and store its result."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from pisigma.errors import PisigmaError
from pisigma.export.output_file import write_whole
from pisigma.studies.papers.page import PAGE, page_text
from pisigma.studies.papers.pictures import draw_pictures
from pisigma.studies.papers.published import read_published
from pisigma.studies.papers.stored_results import read_results, run_recipe


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Args:
        arguments: of the command line; None takes the process's.

    Returns:
        The exit status: 0 done, 2 something is missing or does not fit.
    """
    parser = argparse.ArgumentParser(
        prog="python -m pisigma.studies.papers",
        description="Write README.md and figures/ of a folder of recipes from its results/, or run a recipe first.",
    )
    parser.add_argument("folder", type=Path, help="the folder of the recipes, such as training")
    parser.add_argument("--run", metavar="NAME", help="run this recipe and store its result, nothing else")
    parser.add_argument("--data", type=Path, metavar="CSV", help="measured data, for --run")
    given = parser.parse_args(arguments)
    if given.data and not given.run:
        parser.error("--data is for --run")
    try:
        if given.run:
            run_recipe(given.folder, given.run, given.data)
        else:
            write_page(given.folder)
    except PisigmaError as problem:
        print(f"pisigma: {problem}", file=sys.stderr)
        return 2
    return 0


def write_page(folder: Path) -> None:
    """Write the page and its pictures.

    Args:
        folder: the folder of the recipes.

    Raises:
        PisigmaError: something is missing or does not fit; the page is as it was.
    """
    text = page_text(folder)
    draw_pictures(folder, read_published(folder), read_results(folder))
    write_whole(folder / PAGE, text)


if __name__ == "__main__":
    sys.exit(main())
