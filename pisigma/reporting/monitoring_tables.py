"""Tables of sessions and control charts."""

from collections.abc import Sequence

from pisigma.lifetime.monitoring.charts import Chart
from pisigma.lifetime.monitoring.history import Record
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
