"""`pisigma report`: one page by which a calibration is accepted."""

from pathlib import Path
from typing import Annotated, Any

import typer


def report(
    model: Annotated[Path, typer.Argument(help="Model folder.")],
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
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write a report as one HTML page: how accurate, where worst, what limits it, what to measure next."""
    from pisigma.cli.output import WIDTH_WITHOUT_TERMINAL, print_json
    from pisigma.cli.progress import progress_of
    from pisigma.export.output_file import check_output, write_whole
    from pisigma.measurement.dataset import Measurements
    from pisigma.model.folder.model_folder import load_model
    from pisigma.reporting.page.content import report_content
    from pisigma.reporting.page.figures import check_figures, write_figures
    from pisigma.reporting.page.page import draw_figures, render_page
    from pisigma.reporting.page.summary import summary_of

    check_output(out, (".html", ".htm"), "a report")
    if figures is not None:
        check_figures(figures)
    loaded = load_model(model)
    with progress_of("report") as tell:
        tell("judging rows")
        content = report_content(
            loaded, model, None if data is None else Measurements.read_csv(data, loaded.robot)
        )
        tell("drawing")
        drawn = draw_figures(content)
        write_whole(out, render_page(content, drawn))
        written = [] if figures is None else write_figures(drawn.all, figures)
    if as_json:
        result: dict[str, Any] = {"report": str(out), "figures": [str(path) for path in written]}
        print_json(result | summary_of(content))
        return
    import textwrap

    typer.echo(textwrap.fill(content.verdict.sentence, WIDTH_WITHOUT_TERMINAL))
    typer.echo(f"Report written to {out}{f', {len(written)} figures to {figures}' if written else ''}.")
