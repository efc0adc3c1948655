"""Intrinsics of a camera as a table."""

import math
from collections.abc import Iterable

from pisigma.reporting.tables import Table


def intrinsics_table(parameters: Iterable[tuple[str, float, float, str]]) -> Table:
    """One row a number of the camera, to two digits of its standard deviation.

    Args:
        parameters: name, value, standard deviation (0 of what is held), and unit of each.
    """
    return Table(
        ("parameter", "value", "standard deviation", "unit"), tuple(_row(*one) for one in parameters)
    )


def _row(name: str, value: float, sigma: float, unit: str) -> tuple[str, ...]:
    decimals = max(1 - math.floor(math.log10(sigma)), 0) if sigma > 0 else 0
    return (name, f"{value:.{decimals}f}", f"{sigma:.{decimals}f}" if sigma > 0 else "held", unit)
