"""Fields of a data set, and rows in the form of fields."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place
from pisigma.measurement.faults import Fault, RowPlace
from pisigma.measurement.readings import READINGS

NUMBERS: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "rotation": (3, 3),
    "sigma_position": (),
    "sigma_rotation": (),
    "payload": (),
    "temperature": (),
    "touch": (),
    "distance": (),
    "anchor_place": (3,),
    "approach": (-1,),
    "torque": (-1,),
}
"""Shape of one row of every numeric field; -1 stands for the number of joints."""
TEXTS = ("target", "frame", "split", "socket", "touch_axis", "anchor", "pair", "date", "image")
"""Names of the text fields."""

OnBadRow = Literal["error", "leave_out"]
Kind = str
"""Kind of measurement in a row: "pose", "position", "rotation", "touch", "socket", "distance", or the name of a
registered sensor. An orientation alone is a "rotation"; with a position it is a "pose"."""
KINDS = ("pose", "position", "rotation", "touch", "socket", "distance")
"""The built-in kinds of measurement."""


@dataclass(frozen=True)
class UnusableRow:
    """A row of a file that could not be used.

    Attributes:
        line: line number of the row in the file.
        reason: sentence that states what is wrong, in which column, and what to do.
        fault: the reason as a `Fault`, if one value of the row is faulty.
    """

    line: int
    reason: str
    fault: Fault | None = None

    @staticmethod
    def from_fault(line: int, fault: Fault) -> "UnusableRow":
        """Return the row whose reason is the text of a fault."""
        return UnusableRow(line, str(fault), fault)

    def error(self, file: str) -> MeasurementError:
        """Return the exception for this row of the given file."""
        return (self.fault or Fault(self.reason)).error(Place(file, self.line))


@dataclass(frozen=True, eq=False)
class MeasuredFields:
    """Rows of measurements by field, in SI units; see `Measurements` for the meaning of the fields.

    Files are read and written, and rows are checked, selected and joined, in this form.

    Attributes:
        numbers: numeric fields, one entry per row: "q", and the measured ones among those of `NUMBERS` and of
            registered sensors.
        texts: text fields, one entry per row: those present among the fields of `TEXTS` and of registered sensors.
        line: per row, the line of the file from which it was read; 0 for rows that were not read from a file.
        source: the file, or a name for the origin of the rows.
        left_out: rows of the file that could not be used, with the reasons.
        origin: per row, the file from which it was read if rows come from several files; otherwise empty.
        last_line: per row, its last line in the file, for images with a line per corner; empty if equal to `line`.
    """

    numbers: Mapping[str, Tensor]
    texts: Mapping[str, tuple[str, ...]]
    line: tuple[int, ...]
    source: str
    left_out: tuple[UnusableRow, ...] = field(default=())
    origin: tuple[str, ...] = ()
    last_line: tuple[int, ...] = ()

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return len(self.numbers["q"])

    def text(self, name: str) -> tuple[str, ...]:
        """Return a text field; "" in every row if the data set does not have it."""
        return self.texts.get(name) or ("",) * self.rows

    def array(self, name: str, *shape: int) -> Float64[np.ndarray, "rows *shape"]:
        """Return a numeric field with rows of the given shape; NaN in every row if the data set does not have it."""
        values = self.numbers.get(name)
        if values is None:
            return np.full((self.rows, *shape), np.nan)
        array: np.ndarray = values.detach().cpu().numpy()
        return array

    def place_of(self, row: int, column: str | None = None) -> RowPlace:
        """Return the place of a row (from 0) for messages: file and line, or source and row, and its image."""
        line = self.line[row] if row < len(self.line) else 0
        source, image = self.origin[row] if self.origin else self.source, self.text("image")[row]
        return RowPlace(source, line or None, column, None if line else row, image)

    def place_text(self, row: int) -> str:
        """Return the place of a row as text; see `place_of`."""
        return str(self.place_of(row))

    def is_measured(self, kind: Kind) -> Bool[Tensor, " rows"]:
        """Return the mask of the rows that contain a measurement of a kind.

        A row with a position and an orientation is a "pose" only, neither a "position" nor a "rotation".
        """
        if kind == "socket":
            names = torch.tensor([bool(name) for name in self.text("socket")], dtype=torch.bool)
            return names.to(self.numbers["q"].device)
        if kind in READINGS:
            columns = [self._filled(name) for name in READINGS[kind].numbers]
            return torch.stack(columns).all(0)
        if kind in ("touch", "distance"):
            return self._filled(kind)
        position, rotation = self._filled("position"), self._filled("rotation")
        if kind == "pose":
            return position & rotation
        if kind == "position":
            return position & ~rotation
        if kind == "rotation":
            return rotation & ~position
        raise KeyError(kind)

    def _filled(self, name: str) -> Bool[Tensor, " rows"]:
        if name not in self._filled_rows:
            values = self.numbers.get(name)
            if values is None:
                filled = torch.zeros(self.rows, dtype=torch.bool, device=self.numbers["q"].device)
            else:
                filled = torch.isfinite(values.reshape(self.rows, math.prod(values.shape[1:]))).all(-1)
            self._filled_rows[name] = filled
        return self._filled_rows[name]

    @cached_property
    def _filled_rows(self) -> dict[str, Bool[Tensor, " rows"]]:
        """Masks of the rows with a value, by numeric field; cached on first use."""
        return {}

    def select(self, rows: Tensor) -> "MeasuredFields":
        """Return the rows that an int64 index selects, in the order of the index."""
        chosen = rows.tolist()
        return replace(
            self,
            numbers={name: values[rows] for name, values in self.numbers.items()},
            texts={name: tuple(texts[row] for row in chosen) for name, texts in self.texts.items()},
            line=tuple(self.line[row] for row in chosen),
            last_line=tuple(self.last_line[row] for row in chosen) if self.last_line else (),
            origin=tuple(self.origin[row] for row in chosen) if self.origin else (),
        )


def joined_fields(data: Sequence[MeasuredFields]) -> MeasuredFields:
    """Concatenate data sets; fields that a data set does not have are NaN or "" in its rows.

    Args:
        data: one or more data sets with the same number of joints.
    """

    def filled(one: MeasuredFields, name: str, row: torch.Size) -> Tensor:
        values = one.numbers.get(name)
        return one.numbers["q"].new_full((one.rows, *row), torch.nan) if values is None else values

    sources = dict.fromkeys(one.source for one in data)
    shapes = {name: values.shape[1:] for one in data for name, values in one.numbers.items()}
    return MeasuredFields(
        numbers={name: torch.cat([filled(one, name, row) for one in data]) for name, row in shapes.items()},
        texts={
            name: tuple(text for one in data for text in one.text(name))
            for name in dict.fromkeys(name for one in data for name in one.texts)
        },
        line=tuple(line for one in data for line in one.line),
        last_line=tuple(line for one in data for line in one.last_line or one.line)
        if any(one.last_line for one in data)
        else (),
        source=" + ".join(sources),
        left_out=tuple(row for one in data for row in one.left_out),
        origin=tuple(name for one in data for name in one.origin or (one.source,) * one.rows)
        if len(sources) > 1
        else (),
    )
