"""What is wrong with a row of measurements, and where the row comes from."""

from dataclasses import dataclass, replace
from typing import Any

from pisigma.files.errors import MeasurementError, Place


@dataclass(frozen=True)
class RowPlace(Place):
    """Where a row of measurements comes from.

    Attributes:
        row: its number, counted from 0, where it comes from no line of a file.
        image: the image that it was measured in; "" where it was measured in none.
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
    """What is wrong with a row; see `PisigmaError` for the fields.

    Attributes:
        problem: a clause without a full stop; without it the message says ``expected ..., got ...``.
        column: name of the (first) column at fault, or its number from 1; None where the whole row is meant.
        expected: what was expected.
        value: what was given instead.
        remedy: what to do about it, an imperative clause without a full stop.
    """

    problem: str = ""
    column: str | int | None = None
    expected: str = ""
    value: Any = None
    remedy: str = ""

    def error(self, at: Place) -> MeasurementError:
        """Return the exception for a row at `at`."""
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
