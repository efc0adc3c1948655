"""The fields of a data set: which there are, and rows of them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

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
}
"""Fields that are numbers, with the shape of a row; -1 stands for the number of joints."""
TEXTS = ("target", "frame", "split", "socket", "touch_axis", "anchor", "pair", "date", "image")
"""Fields that are texts."""

OnBadRow = Literal["error", "leave_out"]
Kind = str
"""What a sensor measured in a row: "pose", "position", "rotation", "touch", "socket", "distance", or the name of a
registered sensor. The orientation alone is "rotation"; together with a position it makes a "pose"."""
KINDS = ("pose", "position", "rotation", "touch", "socket", "distance")
"""The kinds that are always there."""


@dataclass(frozen=True)
class LeftOut:
    """A row of a file that could not be used.

    Attributes:
        line: its line in the file.
        reason: the column at fault, what stands there and what to do.
    """

    line: int
    reason: str


@dataclass(frozen=True, eq=False)
class MeasuredFields:
    """Rows of measurements field by field, in SI units; see `Measurements` for what the fields mean.

    This is the form in which files are read and written, and in which rows are checked, chosen and joined.

    Attributes:
        numbers: "q" and the fields of `NUMBERS` and of registered sensors that are there, each with one entry a row.
        texts: the fields of `TEXTS` and of registered sensors that are there, each with one entry a row.
        line: per row, the line of the file it came from (0 where it came from none).
        source: the file, or what made the rows.
        left_out: rows of the file that are not here, and why.
        origin: per row, the file it came from, where rows came from several; else nothing.
    """

    numbers: Mapping[str, Tensor]
    texts: Mapping[str, tuple[str, ...]]
    line: tuple[int, ...]
    source: str
    left_out: tuple[LeftOut, ...] = field(default=())
    origin: tuple[str, ...] = ()

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return len(self.numbers["q"])

    def text(self, name: str) -> tuple[str, ...]:
        """Return a field of texts, "" in every row where it is not there."""
        return self.texts.get(name) or ("",) * self.rows

    def array(self, name: str, *shape: int) -> Float64[np.ndarray, "rows *shape"]:
        """Return a field of numbers, NaN in every row where it is not there; `shape` is that of a row."""
        values = self.numbers.get(name)
        if values is None:
            return np.full((self.rows, *shape), np.nan)
        array: np.ndarray = values.detach().cpu().numpy()
        return array

    def label(self, row: int) -> str:
        """Name a row as complaints do: by file and line, or by source and row counted from 0, and by its image."""
        line = self.line[row] if row < len(self.line) else 0
        source, image = self.origin[row] if self.origin else self.source, self.text("image")[row]
        where = f"{source}, line {line}" if line else f"{source}, row {row}"
        return f"{where} (image '{image}')" if image else where

    def measured(self, kind: Kind) -> Bool[Tensor, " rows"]:
        """Say for every row whether it holds a measurement of a kind.

        A row with position and orientation is of the kind "pose" and of no other.
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
        """By field of numbers, the rows in which it is filled, once that was asked for."""
        return {}

    def select(self, rows: Tensor) -> "MeasuredFields":
        """Return the rows of an int64 index, in its order."""
        chosen = rows.tolist()
        return replace(
            self,
            numbers={name: values[rows] for name, values in self.numbers.items()},
            texts={name: tuple(texts[row] for row in chosen) for name, texts in self.texts.items()},
            line=tuple(self.line[row] for row in chosen),
            origin=tuple(self.origin[row] for row in chosen) if self.origin else (),
        )


def joined_fields(data: Sequence[MeasuredFields]) -> MeasuredFields:
    """Put the rows of several data sets behind each other; what one of them lacks is NaN or "" in its rows.

    Args:
        data: one or more, of equally many joints.
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
        source=" + ".join(sources),
        left_out=tuple(row for one in data for row in one.left_out),
        origin=tuple(name for one in data for name in one.origin or (one.source,) * one.rows)
        if len(sources) > 1
        else (),
    )
