"""Faults and places of rows of measurements."""

from dataclasses import dataclass, replace
from typing import Any

from pisigma.files.errors import MeasurementError, Place


@dataclass(frozen=True)
class RowPlace(Place):
    """The place of a row of measurements.

    Attributes:
        row: index of the row, from 0, if it does not come from a line of a file.
        image: the image from which the row was measured; "" if there is no image.
    """

    row: int | None = None
    image: str = ""

    def __str__(self) -> str:
        parts = [str(Place(self.file, self.line))]
        parts += [f"row {self.row}"] if self.row is not None else []
        parts += [f"image '{self.image}'"] if self.image else []
        column = f"'{self.column}'" if isinstance(self.column, str) else self.column
        parts += [f"{'column' if self.row is None else 'field'} {column}"] if column is not None else []
        return ", ".join(parts)


@dataclass(frozen=True)
class Fault:
    """A fault of a row; see `PisigmaError` for the fields.

    Attributes:
        problem: clause without a full stop that states what is wrong; if empty, the message is ``expected ..., got
            ...``.
        column: name of the first faulty column, or its number from 1; None for the whole row.
        expected: what was expected.
        value: what was given instead.
        remedy: imperative clause without a full stop that states how to correct the fault.
    """

    problem: str = ""
    column: str | int | None = None
    expected: str = ""
    value: Any = None
    remedy: str = ""

    def error(self, at: Place) -> MeasurementError:
        """Return the exception for this fault at the place `at`."""
        return MeasurementError(
            self.problem,
            expected=self.expected,
            value=self.value,
            at=replace(at, column=self.column),
            remedy=self.remedy,
        )

    def __str__(self) -> str:
        problem = str(MeasurementError(self.problem, expected=self.expected, value=self.value))
        column = f"'{self.column}'" if isinstance(self.column, str) else self.column
        at = "" if column is None else f" (column {column})"
        return f"{problem.removesuffix('.')}{at}{'; ' if self.remedy else ''}{self.remedy}"
