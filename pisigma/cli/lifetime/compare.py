"""`pisigma compare`: in what two models of one robot differ, and what that means for the tool."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, complete_model
from pisigma.cli.output import print_json, print_lines, print_table, progress_of, screen_width
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.workflow.settings.comparison import ComparisonSettings

if TYPE_CHECKING:
    from pisigma.workflow.compare import ComparedModels

First = Annotated[
    str,
    typer.Argument(
        metavar="A", help="Model folder, or 'nominal' or 'geometric'.", autocompletion=complete_model
    ),
]
Second = Annotated[
    str,
    typer.Argument(metavar="B", help="What it is compared with, likewise.", autocompletion=complete_model),
]
Rows = Annotated[Path | None, typer.Option(help="Measurements (CSV) that both models predict.")]
Program = Annotated[
    Path | None,
    typer.Option(
        help="Joint values or poses (CSV) of a program that was taught with A: what it misses under B."
    ),
]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with a map of the workspace.")]


@takes_settings
def compare(
    first: First,
    second: Second,
    settings: ComparisonSettings,
    rows: Rows = None,
    program: Program = None,
    page: Page = None,
    as_json: AsJson = False,
) -> None:
    """Say in what two models of one robot differ: parameters, positions of the tool, rows and programs.

    The significance of differences is from the posteriors of both models. Exit status 3 where the rows are not to be
    trusted.
    """
    from pisigma.files.output_file import check_page
    from pisigma.workflow import compare as workflow

    if page is not None:
        stated = settings.cameras.files if settings.cameras else ()
        check_page(page, (Path(first), Path(second), rows, program, *stated))
    with progress_of("compare") as progress:
        progress("both models")
        compared = workflow.compare(first, second, rows, program, settings)
        if page is not None:
            compared.save_page(page)
    if as_json:
        print_json(compared.to_json())
    else:
        _print(compared, page)
    if compared.diagnostics:
        raise AcceptanceError(" ".join(one.sentence for one in compared.diagnostics))


def _print(compared: "ComparedModels", page: Path | None) -> None:
    """Print what differs, the parameters side by side, and distances of the tool."""
    from pisigma.reporting.comparison_tables import comparison_tables
    from pisigma.reporting.difference_tables import difference_table
    from pisigma.reporting.tables import pose_rows

    first, second = compared.models
    print_lines(compared.sentences)
    print_table(
        f"parameters of {first} (A) and {second} (B)", *difference_table(compared.parameters, ("A", "B"))
    )
    distances = {what: one.errors.figures for what, one in compared.displacements.items()}
    print_table("distances of the tool", *pose_rows(distances))
    if compared.rows is not None:
        for title, table in comparison_tables(compared.rows, "the rows", screen_width()):
            print_table(title, *table)
    print_lines(f"Warning: {one}" for one in compared.warnings)
    if page is not None:
        print_lines([f"Page written to {page}."])
