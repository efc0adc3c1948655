"""Measurements: joint values commanded, and what a sensor saw there."""

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.robot import Robot
from pisigma.se3 import transform

OnBadRow = Literal["error", "leave_out"]

_SHAPES: dict[str, tuple[int, ...]] = {
    "position": (3,),
    "rotation": (3, 3),
    "sigma_position": (),
    "sigma_rotation": (),
    "payload": (),
    "temperature": (),
}
_TEXTS = ("frame", "target", "split")
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
class Measurements:
    """One row a measurement, in SI units.

    What was not measured in a row is NaN there; a column that no row has is None.

    Attributes:
        q: commanded joint values [rad or m], as the controller counts.
        position: measured position of the target in its frame [m].
        rotation: measured rotation of the tool in its frame.
        frame: per row, the frame the sensor measures from; "" where the file names none.
        target: per row, which reflector on the tool was seen; "" where the file names none.
        sigma_position: per row, standard deviation of a measured coordinate [m], where given.
        sigma_rotation: per row, standard deviation of a measured angle [rad], where given.
        split: per row "train" or "test" (column `set`), where given.
        payload: per row [kg], where given.
        temperature: per row [deg C], where given.
        line: per row, the line in the file it came from (0 where it came from none).
        source: the file, or what made the rows.
        left_out: rows of the file that are not here, and why.

    Raises:
        MeasurementError: the parts do not fit together, or a value cannot be one; the message names the row.
    """

    q: Float64[Tensor, "rows dof"]
    position: Float64[Tensor, "rows 3"] | None = None
    rotation: Float64[Tensor, "rows 3 3"] | None = None
    frame: tuple[str, ...] = ()
    target: tuple[str, ...] = ()
    sigma_position: Float64[Tensor, " rows"] | None = None
    sigma_rotation: Float64[Tensor, " rows"] | None = None
    split: tuple[str, ...] | None = None
    payload: Float64[Tensor, " rows"] | None = None
    temperature: Float64[Tensor, " rows"] | None = None
    line: tuple[int, ...] = ()
    source: str = "memory"
    left_out: tuple[LeftOut, ...] = ()

    def __post_init__(self) -> None:
        """Fill in the names that were not given and check that everything fits together."""
        if self.q.ndim != 2 or self.q.shape[1] == 0:
            raise MeasurementError(
                f"{self.source}: joint values of shape (rows, joints) were wanted, got {tuple(self.q.shape)}."
            )
        for name, default in (("frame", ""), ("target", ""), ("line", 0)):
            object.__setattr__(self, name, tuple(getattr(self, name)) or (default,) * self.rows)
        if self.split is not None:
            object.__setattr__(self, "split", tuple(self.split))
        self._check_shapes()
        self._refuse(~torch.isfinite(self.q).all(-1), "q", "is not finite; give every joint value")
        self._check_values()
        self._check_split()

    def _check_shapes(self) -> None:
        """One row per measurement, float64, on one device."""
        for name, shape in {"q": (self.dof,), **_SHAPES}.items():
            values = getattr(self, name)
            if values is None:
                continue
            if tuple(values.shape) != (self.rows, *shape):
                raise MeasurementError(
                    f"{self.source}: '{name}' of shape {(self.rows, *shape)} was wanted for {self.rows} "
                    f"rows, got {tuple(values.shape)}."
                )
            if values.dtype != torch.float64:
                raise MeasurementError(
                    f"{self.source}: '{name}' in float64 was wanted, got {values.dtype}; convert it."
                )
            if values.device != self.q.device:
                raise MeasurementError(
                    f"{self.source}: '{name}' is on {values.device}, but q is on {self.q.device}; move it "
                    "there."
                )
        for name in (*_TEXTS, "line"):
            texts = getattr(self, name)
            if texts is not None and len(texts) != self.rows:
                raise MeasurementError(
                    f"{self.source}: '{name}' has {len(texts)} entries for {self.rows} rows."
                )

    def _check_values(self) -> None:
        """What is not NaN is finite and can be; a position or a rotation is there whole or not at all."""
        for name in _SHAPES:
            values = getattr(self, name)
            if values is None:
                continue
            flat = values.reshape(self.rows, math.prod(_SHAPES[name]))
            missing = torch.isnan(flat)
            self._refuse(torch.isinf(flat).any(-1), name, "is infinite; give NaN where nothing was measured")
            self._refuse(missing.any(-1) & ~missing.all(-1), name, "is NaN in part; give all of it or none")
            if name.startswith("sigma"):
                self._refuse(flat[:, 0] <= 0, name, "is not above 0; give a standard deviation or NaN")
        if self.payload is not None:
            self._refuse(self.payload < 0, "payload", "is below 0; give a mass or NaN")
        if self.rotation is not None:
            R = self.rotation
            deviation = (R.mT @ R - torch.eye(3, dtype=R.dtype, device=R.device)).abs().amax((-1, -2))
            left_handed = (torch.linalg.cross(R[..., 0], R[..., 1]) * R[..., 2]).sum(-1) < 0
            self._refuse(deviation > _ROTATION_TOLERANCE, "rotation", "is not orthonormal; normalise it")
            self._refuse(
                left_handed, "rotation", "is left-handed; a reflection is no rotation, check its axes"
            )

    def _check_split(self) -> None:
        """Nothing but train and test."""
        for row, name in enumerate(self.split or ()):
            if name not in _SPLITS:
                raise MeasurementError(
                    f"{self.place(row)}: split '{name}' is unknown; {nearest_choice(name, _SPLITS)}"
                )

    def _refuse(self, bad: Bool[Tensor, " rows"], name: str, what: str) -> None:
        """Raise for the first bad row, if there is one."""
        if bad.any():
            row = int(bad.nonzero()[0])
            value = getattr(self, name)[row].tolist()
            raise MeasurementError(f"{self.place(row)}: {name} {value} {what}.")

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return self.q.shape[0]

    @property
    def dof(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    @property
    def kind(self) -> Literal["pose", "position"]:
        """What the sensor saw: "pose" where there are rotations, else "position"."""
        return "position" if self.rotation is None else "pose"

    @property
    def T(self) -> Float64[Tensor, "rows 4 4"]:
        """Measured poses in the frame of their row, NaN where a row has none.

        Raises:
            MeasurementError: no row has both position and orientation.
        """
        if self.rotation is None or self.position is None:
            lacking = "orientation" if self.rotation is None else "position"
            raise MeasurementError(
                f"{self.source}: poses were wanted, but no {lacking} was measured; use the other part alone "
                "or measure poses."
            )
        return transform(self.rotation, self.position)

    def place(self, row: int) -> str:
        """Where a row is from, as complaints say it: file and line, or source and row counted from 0."""
        line = self.line[row] if len(self.line) == self.rows else 0
        return f"{self.source}, line {line}" if line else f"{self.source}, row {row}"

    def select(self, index: Tensor) -> "Measurements":
        """The rows of an index, in its order, or of a mask, with everything that belongs to them.

        Args:
            index: int64 numbers of rows, or one bool per row.

        Raises:
            MeasurementError: the index is outside the rows, or the mask has another length.
        """
        if index.ndim != 1 or index.dtype not in (torch.int64, torch.bool):
            raise MeasurementError(
                f"{self.source}: an int64 index or a boolean mask of one axis was wanted, got {index.dtype} "
                f"of shape {tuple(index.shape)}."
            )
        if index.dtype == torch.bool:
            if index.shape[0] != self.rows:
                raise MeasurementError(
                    f"{self.source}: a mask of {self.rows} rows was wanted, got {index.shape[0]}."
                )
            index = index.nonzero()[:, 0]
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < self.rows:
            raise MeasurementError(
                f"{self.source}: rows 0 to {self.rows - 1} were wanted, the index goes from "
                f"{int(index.min())} to {int(index.max())}."
            )
        chosen: dict[str, Any] = {}
        places = index.tolist()
        for name in ("q", *_SHAPES, *_TEXTS, "line"):
            values = getattr(self, name)
            if isinstance(values, Tensor):
                chosen[name] = values[index]
            elif values is not None:
                chosen[name] = tuple(values[place] for place in places)
        return replace(self, **chosen)

    def content_hash(self) -> str:
        """SHA-256 (hexadecimal) of the values, wherever they came from: equal values, equal hash."""
        digest = hashlib.sha256()
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name in ("line", "source", "left_out") or value is None:
                continue
            if isinstance(value, Tensor):
                array = value.detach().cpu().numpy().astype("<f8") + 0.0  # -0.0 becomes 0.0
                array[np.isnan(array)] = np.nan  # there are many NaN, one is enough
                digest.update(f"{item.name} {array.shape}:".encode() + array.tobytes())
            else:
                digest.update(f"{item.name}:{json.dumps(value)}".encode())
        return digest.hexdigest()

    @staticmethod
    def read_csv(
        path: str | os.PathLike[str], robot: Robot | None = None, on_bad_row: OnBadRow = "error"
    ) -> "Measurements":
        """Read a CSV file; units come from the column names. See `pisigma.measurement.csv_reading.read_csv`.

        Args:
            path: the file.
            robot: checks number, units and limits of the joints, where given.
            on_bad_row: "error", or "leave_out" to go on without it and to report it in `left_out`.

        Raises:
            MeasurementError: the file or a row cannot be used; the message names file, line and column.
        """
        from pisigma.measurement.csv_reading import read_csv

        return read_csv(path, robot, on_bad_row)

    def write_csv(
        self,
        path: str | os.PathLike[str],
        robot: Robot | None = None,
        revolute: Sequence[bool] | None = None,
    ) -> None:
        """Write a CSV file that `read_csv` reads back. See `pisigma.measurement.csv_writing.write_csv`.

        Args:
            path: the file; written whole or not at all.
            robot: says which joints turn (degrees) and which slide (millimetres).
            revolute: the same per joint, without a robot; with neither, all joints turn.

        Raises:
            MeasurementError: the measurements cannot be written such that they can be read back.
            OutputError: the file cannot be written there.
        """
        from pisigma.measurement.csv_writing import write_csv

        write_csv(self, path, robot, revolute)
