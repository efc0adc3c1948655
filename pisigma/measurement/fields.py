"""The fields of a data set: which there are, what they hold, and whether they fit together."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.lengths import LengthCells, group_faults, row_faults
from pisigma.measurement.readings import (
    READINGS,
    Readings,
    RowFault,
    SensorReadings,
    reading_numbers,
    reading_texts,
)

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
TEXTS = ("frame", "target", "split", "socket", "touch_axis", "anchor", "pair")
"""Fields that are texts."""

OnBadRow = Literal["error", "leave_out"]
Kind = str
"""What a sensor measured in a row: "pose", "position", "rotation", "touch", "socket", "distance", or the name of a
registered sensor. The orientation alone is "rotation"; together with a position it makes a "pose"."""
KINDS = ("pose", "position", "rotation", "touch", "socket", "distance")
"""The kinds that are always there."""

_PARTIAL = ("anchor_place", "approach")  # a row may have some of their values without the others
_SPLITS = ("train", "test")
_ROTATION_TOLERANCE = 1e-6


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
    """

    numbers: Mapping[str, Tensor]
    texts: Mapping[str, tuple[str, ...]]
    line: tuple[int, ...]
    source: str
    left_out: tuple[LeftOut, ...] = field(default=())

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return len(self.numbers["q"])

    def text(self, name: str) -> tuple[str, ...]:
        """Return a field of texts, "" in every row where it is not there."""
        return self.texts.get(name) or ("",) * self.rows

    def label(self, row: int) -> str:
        """Name a row as complaints do: by file and line, or by source and row counted from 0."""
        line = self.line[row] if row < len(self.line) else 0
        return f"{self.source}, line {line}" if line else f"{self.source}, row {row}"

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
        return {
            "pose": position & rotation,
            "position": position & ~rotation,
            "rotation": rotation & ~position,
        }[kind]

    def _filled(self, name: str) -> Bool[Tensor, " rows"]:
        values = self.numbers.get(name)
        if values is None:
            return torch.zeros(self.rows, dtype=torch.bool, device=self.numbers["q"].device)
        return torch.isfinite(values.reshape(self.rows, math.prod(values.shape[1:]))).all(-1)

    def select(self, rows: Tensor) -> "MeasuredFields":
        """Return the rows of an int64 index, in its order."""
        chosen = rows.tolist()
        return replace(
            self,
            numbers={name: values[rows] for name, values in self.numbers.items()},
            texts={name: tuple(texts[row] for row in chosen) for name, texts in self.texts.items()},
            line=tuple(self.line[row] for row in chosen),
        )


def joined_fields(data: Sequence[MeasuredFields]) -> MeasuredFields:
    """Put the rows of several data sets behind each other; what one of them lacks is NaN or "" in its rows.

    Args:
        data: one or more, of equally many joints.
    """

    def filled(one: MeasuredFields, name: str, row: torch.Size) -> Tensor:
        values = one.numbers.get(name)
        return one.numbers["q"].new_full((one.rows, *row), torch.nan) if values is None else values

    shapes = {name: values.shape[1:] for one in data for name, values in one.numbers.items()}
    return MeasuredFields(
        numbers={name: torch.cat([filled(one, name, row) for one in data]) for name, row in shapes.items()},
        texts={
            name: tuple(text for one in data for text in one.text(name))
            for name in dict.fromkeys(name for one in data for name in one.texts)
        },
        line=tuple(line for one in data for line in one.line),
        source=" + ".join(dict.fromkeys(one.source for one in data)),
        left_out=tuple(row for one in data for row in one.left_out),
    )


def check_fields(data: MeasuredFields) -> None:
    """Refuse fields that do not fit together.

    Raises:
        MeasurementError: a shape, type or value is wrong, or rows contradict themselves or each other; the message
            names the row.
    """
    _check_shapes(data)
    _refuse(data, ~torch.isfinite(data.numbers["q"]).all(-1), "q", "is not finite; give every joint value")
    for name in data.numbers:
        if name != "q":
            _check_values(data, name)
    _check_rotations(data)
    for row, name in enumerate(data.texts.get("split", ())):
        if name not in _SPLITS:
            raise MeasurementError(
                f"{data.label(row)}: split '{name}' is unknown; {nearest_choice(name, _SPLITS)}"
            )
    for readings in READINGS.values():
        _check_readings(data, readings)
    _check_lengths(data)


def _check_shapes(data: MeasuredFields) -> None:
    """One row per measurement, float64, on one device."""
    source, q = data.source, data.numbers["q"]
    sizes = {"q": (-1,), **NUMBERS, **dict.fromkeys(reading_numbers(), ())}
    for name, values in data.numbers.items():
        if name not in sizes:
            raise MeasurementError(
                f"{source}: no sensor has readings called '{name}'; {nearest_choice(name, reading_numbers())}"
            )
        shape = (len(q), *(q.shape[1] if size < 0 else size for size in sizes[name]))
        if tuple(values.shape) != shape:
            raise MeasurementError(
                f"{source}: '{name}' of shape {shape} was wanted for {len(q)} rows, got {tuple(values.shape)}."
            )
        if values.dtype != torch.float64:
            raise MeasurementError(
                f"{source}: '{name}' in float64 was wanted, got {values.dtype}; convert it."
            )
        if values.device != q.device:
            raise MeasurementError(
                f"{source}: '{name}' is on {values.device}, but q is on {q.device}; move it there."
            )
    for name, entries in {**data.texts, "line": data.line}.items():
        if name not in (*TEXTS, "line", *reading_texts()):
            raise MeasurementError(
                f"{source}: no sensor has names called '{name}'; {nearest_choice(name, reading_texts())}"
            )
        if len(entries) != len(q):
            raise MeasurementError(f"{source}: '{name}' has {len(entries)} entries for {len(q)} rows.")


def _check_values(data: MeasuredFields, name: str) -> None:
    """What is not NaN is finite and can be; a position or a rotation is there whole or not at all."""
    values = data.numbers[name]
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    missing = torch.isnan(flat)
    _refuse(data, torch.isinf(flat).any(-1), name, "is infinite; give NaN where nothing was measured")
    if name not in _PARTIAL:
        _refuse(data, missing.any(-1) & ~missing.all(-1), name, "is NaN in part; give all of it or none")
    if name.startswith("sigma"):
        _refuse(data, flat[:, 0] <= 0, name, "is not above 0; give a standard deviation or NaN")
    if name == "payload":
        _refuse(data, flat[:, 0] < 0, name, "is below 0; give a mass or NaN")
    if name == "approach":
        stated = ~missing & (flat.abs() != 1)
        _refuse(data, stated.any(-1), name, "has a value other than +1 or -1; give one of them, or NaN")


def _check_rotations(data: MeasuredFields) -> None:
    """Rotations are orthonormal and right-handed."""
    R = data.numbers.get("rotation")
    if R is None:
        return
    deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
    left_handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) < 0
    _refuse(data, deviation > _ROTATION_TOLERANCE, "rotation", "is not orthonormal; normalise it")
    _refuse(data, left_handed, "rotation", "is left-handed; a reflection is no rotation, check its axes")


def _refuse(data: MeasuredFields, bad: Bool[Tensor, " rows"], name: str, what: str) -> None:
    """Raise for the first bad row, if there is one."""
    if bad.any():
        row = int(bad.nonzero()[0])
        raise MeasurementError(f"{data.label(row)}: {name} {data.numbers[name][row].tolist()} {what}.")


def _array(data: MeasuredFields, name: str, *shape: int) -> np.ndarray:
    values = data.numbers.get(name)
    if values is None:
        return np.full((data.rows, *shape), np.nan)
    array: np.ndarray = values.detach().cpu().numpy()
    return array


def _check_readings(data: MeasuredFields, readings: SensorReadings) -> None:
    """The readings of a registered sensor are there whole or not at all, and can be."""
    if not any(name in data.numbers or name in data.texts for name in (*readings.numbers, *readings.texts)):
        return
    values = {name: _array(data, name) for name in readings.numbers}
    missing = np.isnan(np.stack(list(values.values())))
    partial: RowFault = (
        missing.any(0) & ~missing.all(0),
        lambda _: "is there in part; give all of it or none",
    )
    cells: Readings = {**values, **{name: data.text(name) for name in readings.texts}}
    for bad, describe in (partial, *readings.row_faults(cells)):
        if bad.any():
            row = int(bad.argmax())
            raise MeasurementError(f"{data.label(row)}: '{readings.sensor}' {describe(row)}.")


def _check_lengths(data: MeasuredFields) -> None:
    """Rows contradict neither themselves nor each other in what lengths were measured."""
    lengths = {name for name, readings in READINGS.items() if readings.is_length}
    names = {"socket", "touch_axis", "touch", "distance", "anchor", "anchor_place", "pair"}
    if not (names | lengths) & {*data.numbers, *data.texts}:
        return
    cells = LengthCells(
        labels={name: f"'{name}'" for name in (*NUMBERS, *TEXTS, *lengths)} | {"sigma": "'sigma_position'"},
        frame=data.text("frame"),
        socket=data.text("socket"),
        touch_axis=data.text("touch_axis"),
        anchor=data.text("anchor"),
        pair=data.text("pair"),
        position=np.isfinite(_array(data, "position", 3)).all(1),
        touch=_array(data, "touch"),
        distance=_array(data, "distance"),
        anchor_place=_array(data, "anchor_place", 3),
        sigma=_array(data, "sigma_position"),
        others={name: data.measured(name).cpu().numpy() for name in lengths},
    )
    sound = np.ones(data.rows, dtype=bool)
    for faults in (row_faults(cells), group_faults(cells, sound, data.label)):
        for bad, describe in faults:
            if bad.any():
                row = int(bad.argmax())
                raise MeasurementError(f"{data.label(row)}: {describe(row)}.")
