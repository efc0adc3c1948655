"""Tables of sessions, control charts, fleets, and differences of two models."""

from collections.abc import Sequence

from pisigma.lifetime.comparison.parameter_differences import ParameterDifference, ParameterDifferences
from pisigma.lifetime.fleet.status import FleetStatus, RobotStatus
from pisigma.lifetime.monitoring.charts import Chart
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.reporting.tables import Table


def session_table(records: Sequence[Record]) -> Table:
    """Make a table of the sessions: verdict, error, and whether to recalibrate."""
    rows = tuple(
        (
            *(one.date, one.file, str(one.session.rows), one.session.verdict, f"{one.session.rms * 1e3:.3f}"),
            "yes" if one.session.recalibrate else "no",
        )
        for one in records
    )
    return Table(("date", "file", "rows", "verdict", "RMS [mm]", "recalibrate"), rows)


def chart_table(charts: Sequence[Chart]) -> Table:
    """Make a table of the charts: last value, and both statistics as shares of their limits."""
    columns = ("chart", "last", "unit", "EWMA / limit", "CUSUM / limit", "alarm")
    return Table(columns, tuple(_chart_row(one) for one in charts))


def _chart_row(chart: Chart) -> tuple[str, ...]:
    last = float(chart.values[-1])
    shares = (f"{float(share[-1]):.2f}" for share in (chart.ewma_share, chart.cusum_share))
    value = f"{last:.4f}" if last == last else "unobservable"
    return (chart.what, value, chart.unit, *shares, " and ".join(chart.kinds) or "no")


NO_VALUE = "-"


def difference_table(differences: ParameterDifferences, names: tuple[str, str]) -> Table:
    """Make a table of the DH parameters that differ between two models: values, shift with 95 % interval, and p.

    Args:
        differences: differences of the models.
        names: names of the models.
    """
    columns = ("parameter", "unit", *names, "shift alone", "± 95 %", "p")
    shown = [one for one in differences.parameters if one.difference or any(one.deviations)]
    return Table(columns, tuple(_difference_row(one) for one in shown))


def _difference_row(one: ParameterDifference) -> tuple[str, ...]:
    """Return the row of a parameter; without a test it has no shift."""
    values = (f"{value:.4f}" for value in (one.first, one.second))
    if one.shift is None or one.deviation is None or one.p is None:
        return (one.name, one.unit, *values, NO_VALUE, NO_VALUE, NO_VALUE)
    p = "<0.0001" if one.p < 1e-4 else f"{one.p:.2g}"
    return (one.name, one.unit, *values, f"{one.shift:.4f}", f"{NORMAL_95 * one.deviation:.4f}", p)


STATES = ("refused", "missing", "drifting", "overdue", "fine")
ERRORS_NOTE = (
    "RMS is the position error: of rows held out by a cross-validation or a recalibration; otherwise of the "
    "calibration rows, or of a monitored session under its model."
)


def state_table(status: FleetStatus) -> Table:
    """Make a table of the number of robots in each state."""
    return Table(
        ("state", "robots"), tuple((state, str(len(status.robots_in_state(state)))) for state in STATES)
    )


def robot_table(robots: Sequence[RobotStatus]) -> Table:
    """Make a table of the robots: last session and state."""
    return Table(
        ("robot", "session", "rows", "verdict", "RMS [mm]", "days", "state"),
        tuple(_robot_row(one) for one in robots),
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


def _robot_row(one: RobotStatus) -> tuple[str, ...]:
    last = one.last
    days = "" if one.days is None else str(one.days)
    if last is None:
        return (one.robot, "" if one.refused is None else one.refused.session, "", "", "", days, one.state)
    rms = "" if last.error_mm is None else f"{last.error_mm:.3f}"
    return (one.robot, last.session, str(last.rows), last.verdict, rms, days, one.state)
