"""Differences of two models as tables."""

from pisigma.lifetime.comparison.parameter_differences import ParameterDifference, ParameterDifferences
from pisigma.lifetime.recalibration.movement import NORMAL_95
from pisigma.reporting.tables import Table

NO_VALUE = "-"


def difference_table(differences: ParameterDifferences, names: tuple[str, str]) -> Table:
    """Make a table of the DH parameters that differ between two models: values, shift with 95 % interval, and p.

    Args:
        differences: differences of the models.
        names: names of the models.
    """
    columns = ("parameter", "unit", *names, "shift alone", "± 95 %", "p")
    shown = [one for one in differences.parameters if one.difference or any(one.deviations)]
    return Table(columns, tuple(_row(one) for one in shown))


def _row(one: ParameterDifference) -> tuple[str, ...]:
    """Return the row of a parameter; without a test it has no shift."""
    values = (f"{value:.4f}" for value in (one.first, one.second))
    if one.shift is None or one.deviation is None or one.p is None:
        return (one.name, one.unit, *values, NO_VALUE, NO_VALUE, NO_VALUE)
    p = "<0.0001" if one.p < 1e-4 else f"{one.p:.2g}"
    return (one.name, one.unit, *values, f"{one.shift:.4f}", f"{NORMAL_95 * one.deviation:.4f}", p)
