"""`pisigma monitor`: whether a robot still is as its model says, what moved, and how it drifts over the months."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelFolder
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.output import print_json, print_lines, print_table, progress_of
from pisigma.cli.settings_options import takes_settings
from pisigma.workflow.settings.monitoring import MonitorSettings

if TYPE_CHECKING:
    from pisigma.workflow.monitor import Monitoring

Sessions = Annotated[
    list[Path],
    typer.Argument(
        metavar="SESSION...", help="Measurements (CSV), one file a session; five poses or more each."
    ),
]
Page = Annotated[Path | None, typer.Option(help="HTML page to write, with charts of all sessions.")]


@takes_settings
def monitor(
    model: ModelFolder,
    sessions: Sessions,
    settings: MonitorSettings,
    page: Page = None,
    as_json: AsJson = False,
) -> None:
    """Say of every session whether the robot is unchanged or what moved, and follow it over the months.

    The sessions are kept in MODEL.history.sqlite beside the model folder, so that each month's call adds one. Exit
    status 3 where something is to be done: recalibrating pays, a chart is outside its limits, or the error is.
    """
    from pisigma.files.output_file import check_page
    from pisigma.workflow import monitor as workflow

    if page is not None:
        check_page(page, (model, *sessions, *(settings.cameras.files if settings.cameras else ())))
    with progress_of("monitor") as progress:
        monitoring = workflow.monitor(model, sessions, settings, progress)
        if page is not None:
            monitoring.save_page(page)
    _print(monitoring, page, as_json)
    if monitoring.action:
        raise typer.Exit(NOT_ACCEPTED)


def _print(monitoring: "Monitoring", page: Path | None, as_json: bool) -> None:
    """Print a line for every session, what each says, and what they say together."""
    from pisigma.reporting.monitoring_tables import chart_table, session_table

    if as_json:
        print_json(monitoring.to_json())
        return
    print_table(f"sessions of {monitoring.model.name}", *session_table(monitoring.sessions))
    said = [one for one in monitoring.sessions if one.session.verdict != "unchanged"]
    print_lines((f"{one.date}: {one.session.sentence}" for one in said), indent="  ")
    print_lines(dict.fromkeys(line for one in monitoring.sessions for line in one.session.unobservable))
    if len(monitoring.records) > 1:
        print_table(f"charts of {len(monitoring.records)} sessions", *chart_table(monitoring.charts))
    print_lines([*monitoring.sentences, *(f"Warning: {one}" for one in monitoring.warnings)])
    if page is not None:
        print_lines([f"Page written to {page}."])
