"""`pisigma report`: one page by which a calibration is accepted."""

from pathlib import Path
from typing import Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelFolder
from pisigma.cli.output import print_json, print_lines, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.files.errors import AcceptanceError
from pisigma.measurement.camera.camera_files import CameraFiles


@takes_settings
def report(
    model: ModelFolder,
    data: Annotated[
        Path | None,
        typer.Argument(
            help="Measurements (CSV), in the frame that the model was fitted in. [default: what the folder keeps]"
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Page to write (.html).")] = Path("report.html"),
    figures: Annotated[
        Path | None, typer.Option(help="Folder for the figures as PNG and SVG files; made where missing.")
    ] = None,
    cameras: CameraFiles | None = None,
    as_json: AsJson = False,
) -> None:
    """Write a report as one HTML page: how accurate, where worst, what limits it, what to measure next.

    Exit status 3 where the rows are not to be trusted: the page says why.
    """
    from pisigma.workflow import report as workflow

    workflow.check_report_outputs(out, figures, inputs=(model, data, *(cameras.files if cameras else ())))
    with progress_of("report") as progress:
        result = workflow.report(model, data, progress, cameras)
        written = result.save(out, figures)
    if as_json:
        print_json({"report": str(out), "figures": [str(path) for path in written]} | result.to_json())
    else:
        also = f", {len(written)} figures to {figures}" if written else ""
        print_lines([result.verdict, f"Report written to {out}{also}."])
    if result.diagnostics:
        raise AcceptanceError(" ".join(one.sentence for one in result.diagnostics))
