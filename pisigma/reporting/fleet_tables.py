"""The robots of a fleet as tables."""

from collections.abc import Sequence

from pisigma.lifetime.fleet.status import FleetStatus, RobotStatus
from pisigma.reporting.tables import Table

STATES = ("refused", "missing", "drifting", "overdue", "fine")
WHOSE_ERRORS = (
    "RMS is that of the position: of rows left out by a cross-validation or a recalibration, otherwise of the rows "
    "that were calibrated with, or of a monitored session under its model."
)


def state_table(status: FleetStatus) -> Table:
    """How many robots are in each state."""
    return Table(("state", "robots"), tuple((state, str(len(status.in_state(state)))) for state in STATES))


def robot_table(robots: Sequence[RobotStatus]) -> Table:
    """One row per robot: its last session and its state."""
    return Table(
        ("robot", "session", "rows", "verdict", "RMS [mm]", "days", "state"),
        tuple(_row(one) for one in robots),
    )


def not_compared(status: FleetStatus) -> str:
    """Say of how many robots nothing is known of drift; "" where that is of none."""
    count = sum(not one.compared for one in status.robots)
    if not count:
        return ""
    robots = "1 robot has" if count == 1 else f"{count} robots have"
    return (
        f"{robots} several sessions of which each was calibrated by itself, so that nothing is known of drift; "
        "`pisigma fleet run --task monitor` or `--task recalibrate` compares them."
    )


def _row(one: RobotStatus) -> tuple[str, ...]:
    last = one.last
    days = "" if one.days is None else str(one.days)
    if last is None:
        return (one.robot, "" if one.refused is None else one.refused.session, "", "", "", days, one.state)
    rms = "" if last.error_mm is None else f"{last.error_mm:.3f}"
    return (one.robot, last.session, str(last.rows), last.verdict, rms, days, one.state)
