"""`pisigma monitor`: whether a robot has changed since its model was made, and how it drifts over the months."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pisigma.cli.arguments import AsJson, ModelOrCell, Verbose
from pisigma.cli.cell import cell_at, next_lines, refuse_with_cell, report_overrides
from pisigma.cli.endings import NOT_ACCEPTED
from pisigma.cli.output import print_json
from pisigma.cli.progress import progress_of
from pisigma.cli.screen import print_screen
from pisigma.cli.settings_options import StatedSettings, takes_settings
from pisigma.reporting.result_text import sentences, table_block
from pisigma.reporting.verdict import Verdict, counted, rounded, uncapitalised
from pisigma.workflow.settings.monitoring import MonitorSettings

if TYPE_CHECKING:
    from pisigma.lifetime.cell.facts import CellStatus
    from pisigma.workflow.cell.cell import Cell
    from pisigma.workflow.monitor import Monitoring

Sessions = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="SESSION...",
        help="Measurements (CSV), one file per session of five poses or more; not needed for a cell.",
    ),
]
MAX_SESSIONS = 6
"""Sessions that are printed without `--verbose`, the last ones."""

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
    """Check in every session whether the robot has changed, and follow its drift over the months.

    Keeps the sessions in the history of the cell, or of a model outside of a cell in MODEL.history.sqlite next to its
    folder, so that each call adds to them. Exits with status 3 if recalibrating pays, or a chart or the error is
    outside its limits.
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
    """Judge the sessions of a cell that its model in use was not made of."""
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
    monitoring: "Monitoring",
    page: Path | None,
    as_json: bool,
    verbose: bool,
    status: "CellStatus | None" = None,
) -> None:
    """Print the verdict, a line for every session, and what the sessions say together; `status`: of a cell."""
    from pisigma.reporting.lifetime_tables import chart_table, session_table

    if as_json:
        print_json(monitoring.to_json() | ({} if status is None else {"next": status.step.to_json()}))
        return
    sessions = monitoring.sessions
    said = [f"{one.date}: {one.session.sentence}" for one in sessions if one.session.verdict != "unchanged"]
    unobservable = dict.fromkeys(line for one in sessions for line in one.session.unobservable)
    charts = table_block(f"charts of {len(monitoring.records)} sessions", *chart_table(monitoring.charts))
    advice = next((line for line in monitoring.sentences if "`pisigma " in line), "")
    print_screen(
        _verdict(monitoring, advice),
        monitoring.warnings,
        [
            sentences(
                "what the sessions say together", (one for one in monitoring.sentences if one != advice)
            ),
            sentences("what has changed", [*said[-MAX_SESSIONS:], *unobservable], "  "),
            table_block(
                f"last sessions of {monitoring.model.name}", *session_table(sessions[-MAX_SESSIONS:])
            ),
            *([charts] if len(monitoring.records) > 1 else []),
        ],
        [
            table_block(f"sessions of {monitoring.model.name}", *session_table(sessions)),
            sentences("what has changed in all sessions", said, "  "),
        ]
        if len(sessions) > MAX_SESSIONS
        else [],
        [] if page is None else [f"Page written to {page}."],
        verbose,
        [] if status is None else next_lines(status),
    )


def _verdict(monitoring: "Monitoring", advice: str) -> Verdict:
    """Judge a robot by its sessions; `advice` says how to recalibrate it where that pays."""
    sessions, untrusted = monitoring.sessions, len(monitoring.untrusted)
    changed = [one for one in sessions if one.session.verdict != "unchanged"]
    last = f"{sessions[-1].date}, {rounded(sessions[-1].session.rms * 1e3, 0)} mm RMS" if sessions else "none"
    alarms = [chart.what for chart in monitoring.charts if chart.alarm is not None]
    doubts = [f"changed in {len(changed)} of {counted(len(sessions), 'session')}"] if changed else []
    doubts += [f"outside the limits of its chart: {', '.join(alarms)}"] if alarms else []
    doubts += [f"{counted(untrusted, 'session')} left out"] if untrusted else []
    trust = f"yes: unchanged in {counted(len(sessions), 'session')}."
    return Verdict(
        f"last session {last} under the model, base and tool fitted where they were moved.",
        f"{'no' if monitoring.needs_action else 'with caution'}: {'; '.join(doubts)}." if doubts else trust,
        uncapitalised(advice)
        or ("see what has changed below." if doubts else "measure the next session with the same poses."),
    )
