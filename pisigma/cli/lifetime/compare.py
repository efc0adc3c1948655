"""`pisigma compare`: differences between two models of one robot, and their effect on the tool."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, Verbose, complete_model
from pisigma.cli.cell import settings_at
from pisigma.cli.output import print_json, screen_width
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.reporting.result_text import sentence_block, table_block
from pisigma.reporting.verdict import Verdict, count_text, rounded_text
from pisigma.workflow.settings.comparison import ComparisonSettings

if TYPE_CHECKING:
    from pisigma.workflow.compare import ComparedModels

First = Annotated[
    str,
    typer.Argument(
        metavar="A|CELL",
        help="Model folder, 'nominal', 'geometric' or cell.",
        autocompletion=complete_model,
    ),
]
Second = Annotated[
    str | None,
    typer.Argument(
        metavar="B",
        help="Second model, B. [default: for a cell, the model in use, compared with the previous model]",
        autocompletion=complete_model,
    ),
]
Rows = Annotated[
    Path | None, typer.Option(help="Measurements (CSV) with which to compare the predictions of both models.")
]
Program = Annotated[
    Path | None,
    typer.Option(
        help="Joint values or poses (CSV) of a program taught with A, to compute its pose errors under B."
    ),
]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with a map of the workspace.")]


@takes_settings
def compare(
    first: First,
    *,
    second: Second = None,
    settings: StatedSettings[ComparisonSettings],
    rows: Rows = None,
    program: Program = None,
    page: Page = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Compare two models of one robot: parameters, positions of the tool, rows and programs.

    Tests whether differences are significant, with the posteriors of both models. Exits with status 3 if the rows must
    not be trusted.
    """
    from pisigma.files.output_file import check_page
    from pisigma.lifetime.cell.layout import is_cell, previous_and_current_model
    from pisigma.workflow import compare as workflow

    chosen = settings_at(first, "compare", settings)
    if second is None and is_cell(first):
        first, second = map(str, previous_and_current_model(first))
    if second is None:
        raise typer.BadParameter("expected two models, or a cell")
    if page is not None:
        stated = chosen.cameras.files if chosen.cameras else ()
        check_page(page, (Path(first), Path(second), rows, program, *stated))
    with progress_of("compare") as progress:
        progress("parameters, workspace and rows of both models")
        compared = workflow.compare(first, second, rows, program, chosen)
        if page is not None:
            compared.save_page(page)
    if as_json:
        print_json(compared.to_json())
    else:
        _print(compared, page, verbose)
    if compared.diagnostics:
        raise AcceptanceError(" ".join(one.sentence for one in compared.diagnostics))


def _print(compared: "ComparedModels", page: Path | None, verbose: bool) -> None:
    """Print differences, distances of the tool, and the parameters of both models."""
    from pisigma.reporting.comparison_tables import comparison_blocks
    from pisigma.reporting.lifetime_tables import difference_table
    from pisigma.reporting.tables import pose_rows

    first, second = compared.models
    parameters = difference_table(compared.parameters, ("A", "B"))
    distances = {what: one.errors.figures for what, one in compared.displacements.items()}
    short, whole = (
        ([], [])
        if compared.row_comparison is None
        else comparison_blocks(compared.row_comparison, "the rows", screen_width(), verbose)
    )
    head, rows = pose_rows(distances)
    blocks = [
        sentence_block("what differs", compared.sentences),
        *short,
        table_block("distances of the tool", head, [row for row in rows if "mean" not in row[0]]),
        table_block(f"parameters of {first} (A) and {second} (B)", *parameters),
    ]
    closing = [] if page is None else [f"Page written to {page}."]
    print_screen(_verdict(compared), compared.warnings, blocks, whole, closing, verbose)


def _verdict(compared: "ComparedModels") -> Verdict:
    """Return the verdict: how much two models differ, and which is better."""
    first, second = compared.models
    errors = compared.workspace_displacement.errors.figures.figures_by_name
    count, better = len(compared.parameters.significant_differences), compared.better_model
    which = (
        f"the arms differ in {count_text(count, 'parameter')}"
        if count
        else "the arms do not differ beyond uncertainty"
    )
    if compared.diagnostics:
        trust = f"no: {compared.diagnostics[0].sentence}"
    elif compared.row_comparison is None:
        trust = f"{which}; which model is better is not known without --rows."
    else:
        trust = f"{which}; {f'{better} predicts' if better else 'neither clearly predicts'} the rows better."
    return Verdict(
        f"over the workspace, {second} places the tool {rounded_text(errors['rms_mm'])} mm RMS from where {first} "
        f"places it, {rounded_text(errors['max_mm'])} mm at most.",
        trust,
        "measure rows and compare again with --rows."
        if compared.row_comparison is None
        else "correct the problem named above."
        if compared.diagnostics
        else f"use {better}."
        if better
        else "keep the model in use, or measure more rows.",
        "Difference",
    )
