"""Registry of the columns that sensors add to measurement files; `pisigma.measurement.sensors` fills it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.measurement.faults import Fault

RowFault = tuple[Bool[np.ndarray, " rows"], Callable[[int], str | Fault]]
"""Mask of the faulty rows, and a function that returns the fault of a row."""

Readings = Mapping[str, Float64[np.ndarray, " rows"] | Sequence[str]]
"""Values of a sensor by column, in SI units; NaN and "" for empty cells."""

Unit = Literal["deg", "rad", "mm", "m", "kg", "c", ""]
_PER_SI = {"deg": 180 / np.pi, "mm": 1e3}


def to_si(values: Float64[np.ndarray, "*shape"], unit: Unit) -> Float64[np.ndarray, "*shape"]:
    """Convert values to SI units (temperatures remain in deg C)."""
    return values / _PER_SI.get(unit, 1.0)


def from_si(values: Float64[np.ndarray, "*shape"], unit: Unit) -> Float64[np.ndarray, "*shape"]:
    """Convert values to a unit of measurement files; inverse of `to_si`."""
    return values * _PER_SI.get(unit, 1.0)


@dataclass(frozen=True)
class ReadingColumn:
    """A column that a sensor adds to measurement files.

    Attributes:
        name: quantity of the column, such as "tilt_roll"; unique among all columns.
        units: valid units, each of which defines a separate column, such as "tilt_roll_deg"; "" stands for a
            dimensionless number, whose column has the name of the quantity.
        is_text: whether the cells contain names instead of numbers; `units` is then ("",).
        is_optional: whether a file may omit the column although it has the sensor's other columns.
    """

    name: str
    units: tuple[Unit, ...] = ("",)
    is_text: bool = False
    is_optional: bool = False


def no_faults(readings: Readings) -> Iterator[RowFault]:
    """Yield no faults; for sensors without special rules."""
    yield from ()


@dataclass(frozen=True)
class SensorReadings:
    """Columns and rules for the readings of a sensor in measurement files.

    A row contains a reading of the sensor if it contains all numbers of the sensor; rows with only some are refused.

    Attributes:
        sensor: name of the sensor.
        columns: one or more columns, at least one of them with numbers.
        is_length: whether the sensor measures a length; a row contains at most one measured length.
        row_faults: function that finds rows with impossible readings.
    """

    sensor: str
    columns: tuple[ReadingColumn, ...]
    is_length: bool = True
    row_faults: Callable[[Readings], Iterator[RowFault]] = no_faults

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numeric columns."""
        return tuple(column.name for column in self.columns if not column.is_text)

    @property
    def texts(self) -> tuple[str, ...]:
        """Names of the text columns."""
        return tuple(column.name for column in self.columns if column.is_text)


READINGS: dict[str, SensorReadings] = {}
"""Columns that `pisigma.measurement.sensors.register_sensor` added to measurement files, by sensor."""


def numeric_columns() -> tuple[str, ...]:
    """Return the names of all registered numeric columns."""
    return tuple(name for readings in READINGS.values() for name in readings.numbers)


def text_columns() -> tuple[str, ...]:
    """Return the names of all registered text columns."""
    return tuple(name for readings in READINGS.values() for name in readings.texts)
