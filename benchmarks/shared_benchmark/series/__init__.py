"""The series, one file each, with a `SERIES`."""

import importlib
import pkgutil

from shared_benchmark.public_series import Series

NAMES = tuple(sorted(item.name for item in pkgutil.iter_modules(__path__)))
"""Names of all series."""


def series_of(name: str) -> Series:
    """Return a series by its name."""
    series: Series = importlib.import_module(f"shared_benchmark.series.{name}").SERIES
    return series
