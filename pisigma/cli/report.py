"""`pisigma report`: one page by which a calibration is accepted."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell
from pisigma.cli.cell import cell_at, output_in_cell
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.measurement.camera.camera_files import CameraFiles
from pisigma.reporting.result_text import sentences, table_block
from pisigma.reporting.verdict import Verdict, uncapitalised

if TYPE_CHECKING:
    from pisigma.lifetime.cell.acceptance import Acceptance
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.report import Report


@takes_settings
def report(
    model: ModelOrCell,
    data: Annotated[
        Path | None,
        typer.Argument(
            help="Measurements (CSV) in the model's frame. [default: held-out rows in the folder]"
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Page to write (.html). [default: report.html, or in reports/ of a cell]"),
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for the figures as PNG and SVG files.")] = None,
    cameras: CameraFiles | None = None,
    as_json: AsJson = False,
) -> None:
    """Write a report as one HTML page: accuracy, where it is worst, what limits it, what to measure next.

    The report of a cell also contains what its acceptance needs: instrument, uncertainty budget, measured errors, and
    who accepted the model. Exits with status 3 if the rows must not be trusted, or the measured errors are larger than
    the budget explains; the page says why.
    """
    from pisigma.lifetime.cell.layout import REPORTS, model_folder
    from pisigma.workflow import report as workflow

    cell, model = cell_at(model), model_folder(model)
    if out is None:
        out = Path("report.html") if cell is None else output_in_cell(cell, REPORTS, ".html")
    if cameras is None and cell is not None:
        cameras = cell.cameras
    workflow.check_report_outputs(out, figures, inputs=(model, data, *(cameras.files if cameras else ())))
    with progress_of("report") as progress:
        result = workflow.report(model, data, progress, cameras, _acceptance(cell))
        written = result.save(out, figures)
    if as_json:
        print_json({"report": str(out), "figures": [str(path) for path in written]} | result.to_json())
    else:
        also = f", {len(written)} figures to {figures}" if written else ""
        _print(result, [f"Report written to {out}{also}."])
    if result.acceptance is not None and result.acceptance.contradicted:
        from pisigma.reporting.acceptance_tables import contradiction

        raise AcceptanceError(contradiction(result.acceptance))
    if result.diagnostics:
        raise AcceptanceError(" ".join(one.sentence for one in result.diagnostics))


def _acceptance(cell: "Cell | None") -> "Acceptance | None":
    """Collect the acceptance of a cell; None without a cell."""
    if cell is None:
        return None
    from pisigma.workflow.cell.acceptance import acceptance_of

    return acceptance_of(cell)


def _print(result: "Report", closing: list[str]) -> None:
    """Print the verdict of the page, and what it advises to measure."""
    from pisigma.reporting.acceptance_tables import acceptance_sentences, budget_table, contradiction

    content, wrong = result.content, result.diagnostics
    trust = "yes: these rows were held out."
    accepted = result.acceptance
    if wrong:
        trust = f"no: {wrong[0].sentence}"
    elif accepted is not None and accepted.contradicted:
        trust = f"no: {uncapitalised(contradiction(accepted))}"
    elif not content.verdict.held_out:
        trust = "with caution: no held-out rows were judged."
    first, *others = content.advice or ("read the page.",)
    verdict = Verdict(result.verdict, trust, uncapitalised(first))
    blocks = [sentences("further advice", (f"- {one}" for one in others), "  ")]
    if accepted is not None:
        columns, rows = budget_table(accepted)
        lacking = ", ".join(dict.fromkeys(line.partition(":")[0] for line in accepted.not_stated))
        blocks += [
            sentences(
                "acceptance", (*acceptance_sentences(accepted), f"Not stated: {lacking}; see the page."), "  "
            ),
            table_block("Uncertainty budget of one coordinate", columns[:-1], [row[:-1] for row in rows]),
        ]
    print_screen(verdict, [one.sentence for one in wrong[1:]], blocks, closing=closing)
