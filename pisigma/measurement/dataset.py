"""Measurements: joint values commanded, and what a sensor saw there."""

import hashlib
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.measurement.consistency import NUMBERS, TEXTS, check_parts, row_place
from pisigma.robot import Robot
from pisigma.se3 import transform

OnBadRow = Literal["error", "leave_out"]

Kind = Literal["pose", "position", "rotation", "touch", "socket", "distance"]
"""What a sensor sees in a row; the orientation alone is "rotation", with a position it makes a "pose"."""


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

    What was not measured in a row is NaN there, and "" where it is a name; a column that no row has is None.
    A row holds one length at most: a position, a touch, a socket or a distance. The orientation may stand
    beside any of them. What a second sensor saw at the same joint values is a second row.

    Attributes:
        q: commanded joint values [rad or m], as the controller counts.
        position: measured position of the target in its frame [m].
        rotation: measured rotation of the tool in its frame.
        frame: per row, the frame the sensor measures from; "" where the file names none.
        target: per row, which reflector on the tool was seen; "" where the file names none.
        sigma_position: per row, standard deviation of the length that was measured there (of every coordinate
            of a position) [m], where given.
        sigma_rotation: per row, standard deviation of a measured angle [rad], where given.
        split: per row "train" or "test" (column `set`), where given.
        payload: per row [kg], where given.
        temperature: per row [deg C], where given.
        approach: per row and joint, from which side the joint came to its value: +1 as it grew, -1 as it fell,
            NaN where that is not stated.
        socket: per row, the socket that the target's ball sits in; all rows of one share one unknown point.
        touch_axis: per row, the axis ("x", "y" or "z") of the row's frame along which the target's tip
            touched.
        touch: per row, the coordinate at which it touched [m].
        distance: per row [m], from the anchor to the target, or between the targets of the two rows of a
            pair, each of which holds it.
        anchor: per row, the fixed point that the distance is from; its rows share one place and one zero
            offset.
        anchor_place: per row, the place of the anchor in the row's frame [m], where it is known.
        pair: per row, the pair that it belongs to; a pair has exactly two rows, in one frame.
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
    socket: tuple[str, ...] | None = None
    touch_axis: tuple[str, ...] | None = None
    touch: Float64[Tensor, " rows"] | None = None
    distance: Float64[Tensor, " rows"] | None = None
    anchor: tuple[str, ...] | None = None
    anchor_place: Float64[Tensor, "rows 3"] | None = None
    pair: tuple[str, ...] | None = None
    approach: Float64[Tensor, "rows dof"] | None = None
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
        for name in ("socket", "touch_axis", "anchor", "pair"):
            names = getattr(self, name) or ()
            object.__setattr__(self, name, tuple(names) if any(names) else None)
        check_parts({item.name: getattr(self, item.name) for item in fields(self)})

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return self.q.shape[0]

    @property
    def dof(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    def seen(self, kind: Kind) -> Bool[Tensor, " rows"]:
        """For every row, whether it holds a measurement of a kind.

        A row with position and orientation is of the kind "pose" and of no other.
        """
        if kind == "socket":
            names = self.socket or ("",) * self.rows
            return torch.tensor([bool(name) for name in names], dtype=torch.bool, device=self.q.device)
        if kind in ("touch", "distance"):
            return self._there(self.touch if kind == "touch" else self.distance)
        position, rotation = self._there(self.position), self._there(self.rotation)
        return {
            "pose": position & rotation,
            "position": position & ~rotation,
            "rotation": rotation & ~position,
        }[kind]

    def _there(self, values: Tensor | None) -> Bool[Tensor, " rows"]:
        if values is None:
            return torch.zeros(self.rows, dtype=torch.bool, device=self.q.device)
        return torch.isfinite(values.reshape(self.rows, math.prod(values.shape[1:]))).all(-1)

    @property
    def kinds(self) -> frozenset[Kind]:
        """What was measured in any of the rows; empty where nothing was."""
        return frozenset(kind for kind in get_args(Kind) if bool(self.seen(kind).any()))

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
        return row_place(self.source, self.line, row)

    def select(self, index: Tensor) -> "Measurements":
        """The rows of an index, in its order, or of a mask, with everything that belongs to them.

        Args:
            index: int64 numbers of rows, or one bool per row.

        Raises:
            MeasurementError: the index is outside the rows, the mask has another length, or a pair is parted.
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
        for name in ("q", *NUMBERS, *TEXTS, "line"):
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
        """Read a CSV file; units come from the column names. See `pisigma.measurement.csv.reading.read_csv`.

        Args:
            path: the file.
            robot: checks number, units and limits of the joints, where given.
            on_bad_row: "error", or "leave_out" to go on without it and to report it in `left_out`.

        Raises:
            MeasurementError: the file or a row cannot be used; the message names file, line and column.
        """
        from pisigma.measurement.csv.reading import read_csv

        return read_csv(path, robot, on_bad_row)

    def write_csv(
        self,
        path: str | os.PathLike[str],
        robot: Robot | None = None,
        revolute: Sequence[bool] | None = None,
    ) -> None:
        """Write a CSV file that `read_csv` reads back. See `pisigma.measurement.csv.writing.write_csv`.

        Args:
            path: the file; written whole or not at all.
            robot: says which joints turn (degrees) and which slide (millimetres).
            revolute: the same per joint, without a robot; with neither, all joints turn.

        Raises:
            MeasurementError: the measurements cannot be written such that they can be read back.
            OutputError: the file cannot be written there.
        """
        from pisigma.measurement.csv.writing import write_csv

        write_csv(self, path, robot, revolute)
