"""Tables of the robots of a fleet."""

from collections.abc import Sequence

from pisigma.lifetime.fleet.status import FleetStatus, RobotStatus
from pisigma.reporting.tables import Table

STATES = ("refused", "missing", "drifting", "overdue", "fine")
ERRORS_NOTE = (
    "RMS is the position error: of rows held out by a cross-validation or a recalibration; otherwise of the "
    "calibration rows, or of a monitored session under its model."
)


def state_table(status: FleetStatus) -> Table:
    """Make a table of the number of robots in each state."""
    return Table(("state", "robots"), tuple((state, str(len(status.in_state(state)))) for state in STATES))


def robot_table(robots: Sequence[RobotStatus]) -> Table:
    """Make a table of the robots: last session and state."""
    return Table(
        ("robot", "session", "rows", "verdict", "RMS [mm]", "days", "state"),
        tuple(_row(one) for one in robots),
    )


def not_compared(status: FleetStatus) -> str:
    """Say for how many robots drift is unknown; "" where there are none."""
    count = sum(not one.compared for one in status.robots)
    if not count:
        return ""
    robots = "1 robot has" if count == 1 else f"{count} robots have"
    return (
        f"{robots} several sessions that were calibrated separately, so that drift is unknown; `pisigma fleet run "
        "--task monitor` or `--task recalibrate` compares them."
    )


def _row(one: RobotStatus) -> tuple[str, ...]:
    last = one.last
    days = "" if one.days is None else str(one.days)
    if last is None:
        return (one.robot, "" if one.refused is None else one.refused.session, "", "", "", days, one.state)
    rms = "" if last.error_mm is None else f"{last.error_mm:.3f}"
    return (one.robot, last.session, str(last.rows), last.verdict, rms, days, one.state)
