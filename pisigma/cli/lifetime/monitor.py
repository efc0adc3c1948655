"""`pisigma monitor`: changes of a robot since its model was made, and its drift over the months."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, Verbose
from pisigma.cli.cell import cell_at, next_step_lines, refuse_with_cell, report_overrides
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_result
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.workflow.settings.monitoring import MonitorSettings

if TYPE_CHECKING:
    from pisigma.lifetime.cell.status import CellStatus
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.monitor import MonitoringResult

Sessions = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="SESSION...",
        help="Measurements (CSV), one file per session of five poses or more; not needed for a cell.",
    ),
]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with charts of all sessions.")]


@takes_settings
def monitor(
    model: ModelOrCell,
    *,
    sessions: Sessions = None,
    settings: StatedSettings[MonitorSettings],
    page: Page = None,
    verbose: Verbose = False,
    as_json: AsJson = False,
) -> None:
    """Check in every session whether the robot has changed, and track its drift over months.

    Each call adds its sessions to the history: that of the cell, or MODEL.history.sqlite next to a model folder outside
    a cell. Exits with status 3 if rows are implausible, a recalibration is recommended, a control chart raises an
    alarm, or the error exceeds its limit.
    """
    from pisigma.files.output_file import check_page
    from pisigma.workflow import monitor as workflow

    if (cell := cell_at(model)) is not None:
        refuse_with_cell(SESSION=sessions)
        return _monitor_cell(cell, settings, page, as_json, verbose)
    if not sessions:
        raise typer.BadParameter("expected SESSION..., or a cell instead of a model")
    chosen = settings.build()
    if page is not None:
        check_page(page, (model, *sessions, *(chosen.cameras.files if chosen.cameras else ())))
    with progress_of("monitor") as progress:
        monitoring = workflow.monitor(model, sessions, chosen, progress)
        if page is not None:
            monitoring.save_page(page)
    _print(monitoring, page, as_json, verbose)
    if monitoring.needs_action:
        raise typer.Exit(NOT_ACCEPTED)


def _monitor_cell(
    cell: "Cell", settings: StatedSettings[MonitorSettings], page: Path | None, as_json: bool, verbose: bool
) -> None:
    """Check the sessions of a cell that its model in use was not fitted to."""
    from pisigma.files.output_file import check_page

    if page is not None:
        check_page(page, (cell.folder,))
    with progress_of("monitor") as progress:
        monitoring = cell.monitor(progress, **report_overrides(cell, "monitor", settings))
        if page is not None:
            monitoring.save_page(page)
    _print(monitoring, page, as_json, verbose, cell.status())
    if monitoring.needs_action:
        raise typer.Exit(NOT_ACCEPTED)


def _print(
    monitoring: "MonitoringResult",
    page: Path | None,
    as_json: bool,
    verbose: bool,
    status: "CellStatus | None" = None,
) -> None:
    """Print the result; `status` is the status of a cell."""
    from pisigma.workflow.result_texts import monitoring_text

    if as_json:
        print_json(monitoring.to_json() | ({} if status is None else {"next": status.step.to_json()}))
        return
    text = monitoring_text(monitoring, [] if page is None else [f"Page written to {page}."])
    print_result(text, verbose, [] if status is None else next_step_lines(status))
