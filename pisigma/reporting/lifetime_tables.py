"""Tables of sessions, control charts, and differences of two models."""

from collections.abc import Sequence

from pisigma.lifetime.comparison.parameter_differences import ParameterDifference, ParameterDifferences
from pisigma.lifetime.monitoring.charts import Chart
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.reporting.result_text import Table


def session_table(records: Sequence[Record]) -> Table:
    """Return a table of the sessions: verdict, error, and whether to recalibrate."""
    rows = tuple(
        (
            *(one.date, one.file, str(one.session.rows), one.session.verdict, f"{one.session.rms * 1e3:.3f}"),
            "yes" if one.session.recalibrate else "no",
        )
        for one in records
    )
    return Table(("date", "file", "rows", "verdict", "RMS [mm]", "recalibrate"), rows)


def chart_table(charts: Sequence[Chart]) -> Table:
    """Return a table of the charts: last value, and both statistics as shares of their limits."""
    columns = ("chart", "last", "unit", "EWMA / limit", "CUSUM / limit", "alarm")
    return Table(columns, tuple(_chart_row(one) for one in charts))


def _chart_row(chart: Chart) -> tuple[str, ...]:
    last = float(chart.values[-1])
    shares = (f"{float(share[-1]):.2f}" for share in (chart.ewma_to_limit_ratio, chart.cusum_to_limit_ratio))
    value = f"{last:z.4f}" if last == last else "unobservable"
    return (chart.quantity, value, chart.unit, *shares, " and ".join(chart.kinds) or "no")


_NO_VALUE = "-"


def difference_table(differences: ParameterDifferences, model_names: tuple[str, str]) -> Table:
    """Return a table of DH parameters that differ between two models: values, shift with 95 % interval, and p.

    Args:
        differences: differences of the models.
        model_names: names of the models.
    """
    columns = ("parameter", "unit", *model_names, "shift alone", "± 95 %", "p")
    shown = [one for one in differences.parameters if one.difference or any(one.sigmas)]
    return Table(columns, tuple(_difference_row(one) for one in shown))


def _difference_row(one: ParameterDifference) -> tuple[str, ...]:
    """Return the row of a parameter; without a test, the cells of its shift are empty."""
    values = (f"{value:.4f}" for value in (one.first, one.second))
    if one.shift is None or one.sigma is None or one.p_value is None:
        return (one.name, one.unit, *values, _NO_VALUE, _NO_VALUE, _NO_VALUE)
    p = "<0.0001" if one.p_value < 1e-4 else f"{one.p_value:.2g}"
    return (one.name, one.unit, *values, f"{one.shift:z.4f}", f"{NORMAL_95 * one.sigma:.4f}", p)
