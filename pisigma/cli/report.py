"""`pisigma report`: one page by which a calibration is accepted."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell
from pisigma.cli.cell import cell_at, output_in_cell
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.measurement.camera.camera_files import CameraFiles

if TYPE_CHECKING:
    from pisigma.lifetime.cell.acceptance import Acceptance
    from pisigma.workflow.cell.cell import Cell


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
        typer.Option(help="Page to write (.html). [default: report.html, or a file in reports/ of a cell]"),
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(help="Folder for the figures as PNG, SVG and CSV files.")
    ] = None,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            help="Images or videos in which the corners in DATA were detected; the nominal and the calibrated arm are "
            "drawn over them."
        ),
    ] = None,
    cameras: CameraFiles | None = None,
    as_json: AsJson = False,
) -> None:
    """Write a report as one HTML page: accuracy, where it is worst, what limits it, what to measure next.

    The report of a cell also contains what its acceptance needs: instrument, uncertainty budget, measured errors, and
    who accepted the model. Exits with status 3 if the rows must not be trusted, or if the measured errors are larger
    than the budget explains; the page says why.
    """
    from pisigma.lifetime.cell.layout import REPORTS, model_folder
    from pisigma.workflow import report as workflow
    from pisigma.workflow.result_texts import report_doubt, report_text

    cell, model = cell_at(model), model_folder(model)
    if out is None:
        out = Path("report.html") if cell is None else output_in_cell(cell, REPORTS, ".html")
    if cameras is None and cell is not None:
        cameras = cell.cameras
    workflow.check_report_outputs(
        out, figures, inputs=(model, data, *(images or ()), *(cameras.files if cameras else ()))
    )
    with progress_of("report") as progress:
        result = workflow.report(model, data, progress, cameras, _acceptance(cell), images or ())
        written = result.save(out, figures)
    if as_json:
        print_json({"report": str(out), "figures": [str(path) for path in written]} | result.to_json())
    else:
        also = f", {len(written)} figures to {figures}" if written else ""
        print_result(report_text(result, [f"Report written to {out}{also}."]), elsewhere="see the page")
    if doubt := report_doubt(result):
        raise AcceptanceError(doubt)


def _acceptance(cell: "Cell | None") -> "Acceptance | None":
    """Collect the acceptance of a cell; None without a cell."""
    if cell is None:
        return None
    from pisigma.workflow.cell.acceptance import acceptance_of

    return acceptance_of(cell)
