"""The robots of a fleet as tables."""

from collections.abc import Sequence

from pisigma.fleet.status import FleetStatus, RobotStatus
from pisigma.reporting.tables import Table

STATES = ("refused", "missing", "drifting", "overdue", "fine")


def state_table(status: FleetStatus) -> Table:
    """How many robots are in each state."""
    return Table(("state", "robots"), tuple((state, str(len(status.in_state(state)))) for state in STATES))


def robot_table(robots: Sequence[RobotStatus]) -> Table:
    """One row per robot: its last session and its state."""
    return Table(
        ("robot", "session", "rows", "verdict", "RMS [mm]", "days", "state"),
        tuple(_row(one) for one in robots),
    )


def _row(one: RobotStatus) -> tuple[str, ...]:
    last = one.last
    days = "" if one.days is None else str(one.days)
    if last is None:
        return (one.robot, "" if one.refused is None else one.refused.session, "", "", "", days, one.state)
    rms = "" if last.rms_mm is None else f"{last.rms_mm:.3f}"
    return (one.robot, last.session, str(last.rows), last.verdict, rms, days, one.state)
