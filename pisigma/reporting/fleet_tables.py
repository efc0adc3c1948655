"""Tables and verdict of the cells of a fleet; torch is not imported, so `pisigma status FOLDER` starts quickly."""

from collections.abc import Iterable

from pisigma.lifetime.cell.status import CellStatus
from pisigma.lifetime.cell.step import ATTENTION
from pisigma.lifetime.fleet.status import UNREADABLE, FleetStatus
from pisigma.reporting.result_text import Table
from pisigma.reporting.verdict import Verdict, count_text, rounded_text

ERRORS_NOTE = (
    "RMS is the position error under the model in use that the last command found: calibrate (held-out rows or, "
    "without a cross-validation, the rows of the calibration), recalibrate (held-out rows), verify or monitor (the "
    "rows of a session)."
)


def state_table(status: FleetStatus) -> Table:
    """Return a table of the number of cells in each state."""
    return Table(
        ("state", "cells"), tuple((state, str(len(cells))) for state, cells in status.states.items())
    )


def cell_table(cells: Iterable[CellStatus]) -> Table:
    """Return a table of cells: model in use, last session that is not set aside, error and state."""
    return Table(
        ("cell", "model in use", "last session", "RMS [mm]", "found by", "state"),
        tuple(_row(one) for one in cells),
    )


def _row(one: CellStatus) -> tuple[str, ...]:
    model, found = one.facts.in_use, one.last_error
    sessions = [session for session in one.facts.sessions if not session.set_aside]
    error = ("", "") if found is None else (f"{found.rms_mm:.3f}", found.command)
    return (
        one.name,
        model.name if model else "",
        sessions[-1].day if sessions else "",
        *error,
        one.step.state,
    )


def fleet_verdict(status: FleetStatus) -> Verdict:
    """Return the verdict on a fleet: its largest error, and the cells that need attention."""
    worst = next(iter(status.sorted_by_error), None)
    serious = [state for state in status.states if state in (UNREADABLE, *ATTENTION)]
    count = len(status.cells) + len(status.unreadable)
    found = ", ".join(f"{len(status.states[state])} {state}" for state in serious)
    due = sum(one.has_automatic_step for one in status.cells)
    first = next((one for one in status.cells if one.step.state == (serious or [""])[-1]), None)
    return Verdict(
        "not known yet for any cell."
        if worst is None
        else f"largest error {rounded_text(worst[1].rms_mm or 0.0, 0)} mm RMS, of {worst[0].name}.",
        f"{found} of {count_text(count, 'cell')}." if found else "yes: no cell needs attention.",
        f"`pisigma fleet run {status.folder}` ({count_text(due, 'cell')} can be processed)."
        if due
        else f"`{first.step.command}`."
        if first is not None
        else "measure the next sessions when they are due.",
    )
