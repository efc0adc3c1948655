"""Columns that sensors add to measurement files: a registry which `pisigma.measurement.sensors` fills."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float64

RowFault = tuple[Bool[np.ndarray, " rows"], Callable[[int], str]]
"""Rows at fault, and a function that says what is wrong with one of them."""

Readings = Mapping[str, Float64[np.ndarray, " rows"] | Sequence[str]]
"""The cells of a sensor by column, in SI units; NaN and "" where a cell is empty."""

Unit = Literal["deg", "rad", "mm", "m", "kg", "c", ""]
_PER_SI = {"deg": 180 / np.pi, "mm": 1e3}


def to_si(values: Float64[np.ndarray, "*shape"], unit: Unit) -> Float64[np.ndarray, "*shape"]:
    """Convert values to SI units (temperature stays in deg C)."""
    return values / _PER_SI.get(unit, 1.0)


def from_si(values: Float64[np.ndarray, "*shape"], unit: Unit) -> Float64[np.ndarray, "*shape"]:
    """Convert values to a unit of measurement files; inverse of `to_si`."""
    return values * _PER_SI.get(unit, 1.0)


@dataclass(frozen=True)
class ReadingColumn:
    """A column that a sensor adds to measurement files.

    Attributes:
        name: what stands in it, such as "tilt_roll"; no other column has this name.
        units: the units it may be in, each of which makes a column of its own, such as "tilt_roll_deg"; "" is a
            number without a unit, whose column is called as the quantity.
        is_text: whether its cells hold names instead of numbers; then `units` is ("",).
        is_optional: whether a file may have the sensor's other columns without it.
    """

    name: str
    units: tuple[Unit, ...] = ("",)
    is_text: bool = False
    is_optional: bool = False


def no_faults(readings: Readings) -> Iterator[RowFault]:
    """Find nothing wrong with any row."""
    yield from ()


@dataclass(frozen=True)
class SensorReadings:
    """What a sensor writes into measurement files.

    A row holds a reading of the sensor where all of its numbers are there; a row with some of them is refused.

    Attributes:
        sensor: its name.
        columns: one or more, of which at least one holds numbers.
        is_length: whether it measures a length; a row holds one measured length at most.
        row_faults: finds the rows whose readings cannot be.
    """

    sensor: str
    columns: tuple[ReadingColumn, ...]
    is_length: bool = True
    row_faults: Callable[[Readings], Iterator[RowFault]] = no_faults

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the columns that hold numbers."""
        return tuple(column.name for column in self.columns if not column.is_text)

    @property
    def texts(self) -> tuple[str, ...]:
        """Names of the columns that hold names."""
        return tuple(column.name for column in self.columns if column.is_text)


READINGS: dict[str, SensorReadings] = {}
"""By sensor, what `pisigma.measurement.sensors.register_sensor` added to the columns of measurement files."""


def reading_numbers() -> tuple[str, ...]:
    """Return the names of all registered columns that hold numbers."""
    return tuple(name for readings in READINGS.values() for name in readings.numbers)


def reading_texts() -> tuple[str, ...]:
    """Return the names of all registered columns that hold names."""
    return tuple(name for readings in READINGS.values() for name in readings.texts)
