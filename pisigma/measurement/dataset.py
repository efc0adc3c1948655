"""Measurements: joint values commanded, and what a sensor measured there."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.reading import read_fields
from pisigma.measurement.csv.writing import write_fields
from pisigma.measurement.fields import (
    KINDS,
    Kind,
    LeftOut,
    MeasuredFields,
    OnBadRow,
    RowPlace,
    joined_fields,
)
from pisigma.measurement.readings import READINGS
from pisigma.measurement.rules import check_fields
from pisigma.robot import Robot
from pisigma.robot.se3 import transform


@dataclass(frozen=True, eq=False)
class Measurements:
    """One row a measurement, in SI units.

    What was not measured in a row is NaN there, and "" where it is a name; a field that no row has is None.
    A row holds one length at most: a position, a touch, a socket or a distance. The orientation may stand
    beside any of them. What a second sensor measured at the same joint values is a second row.

    Attributes:
        q: commanded joint values [rad or m], as the controller counts.
        position: measured position of the target in its frame [m].
        rotation: measured rotation of the tool in its frame.
        frame: per row, the frame the sensor measures from; "" where the file names none.
        target: per row, which reflector on the tool was measured; "" where the file names none.
        sigma_position: per row, standard deviation of the length that was measured there (of every coordinate
            of a position) [m]; NaN where it is not stated.
        sigma_rotation: per row, standard deviation of a measured angle [rad]; NaN where it is not stated.
        split: per row "train" or "test" (column `set`).
        payload: per row [kg].
        temperature: per row [deg C].
        socket: per row, the socket that the target's ball sits in; all rows of one share one unknown point.
        touch_axis: per row, the axis ("x", "y" or "z") of the row's frame along which the target's tip
            touched.
        touch: per row, the coordinate at which it touched [m].
        distance: per row [m], from the anchor to the target, or between the targets of the two rows of a
            pair, each of which holds it.
        anchor: per row, the fixed point that the distance is from; its rows share one point and one zero
            offset.
        anchor_place: per row, where the anchor is in the row's frame [m]; NaN where that is to be identified.
        pair: per row, the pair that it belongs to; a pair has exactly two rows, in one frame.
        approach: per row and joint, from which side the joint came to its value: +1 as it grew, -1 as it fell,
            NaN where that is not stated.
        date: per row, the day it was measured (ISO 8601, such as "2026-11-22"); "" where it is not stated.
        image: per row, the name of the image that it comes from; "" where it comes from none.
        readings: what registered sensors measured (see `pisigma.measurement.sensors.register_sensor`), by column: one
            number [SI] or one name a row.
        line: per row, the line in the file it came from (0 where it came from none).
        source: the file, or what made the rows.
        left_out: rows of the file that are not here, and why.
        origin: per row, the file it came from, where rows came from several; else nothing.

    Raises:
        MeasurementError: the fields do not fit together, or a value cannot be one; the message names the row.
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
    date: tuple[str, ...] | None = None
    image: tuple[str, ...] | None = None
    readings: Mapping[str, Tensor | tuple[str, ...]] = field(default_factory=dict)
    line: tuple[int, ...] = ()
    source: str = "memory"
    left_out: tuple[LeftOut, ...] = ()
    origin: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Fill in names that are missing and check that everything fits together."""
        if self.q.ndim != 2 or self.q.shape[1] == 0:
            raise MeasurementError(
                f"{self.source}: joint values of shape (rows, joints) were wanted, got {tuple(self.q.shape)}."
            )
        for name, default in (("frame", ""), ("target", ""), ("line", 0)):
            object.__setattr__(self, name, tuple(getattr(self, name)) or (default,) * self.rows)
        if self.split is not None:
            object.__setattr__(self, "split", tuple(self.split))
        for name in ("socket", "touch_axis", "anchor", "pair", "date", "image"):
            names = getattr(self, name) or ()
            object.__setattr__(self, name, tuple(names) if any(names) else None)
        check_fields(self.as_fields())

    def as_fields(self) -> MeasuredFields:
        """Return the rows field by field, without the fields that no row has."""
        return self._fields

    @cached_property
    def _fields(self) -> MeasuredFields:
        present = {
            item.name: value
            for item in fields(self)
            if item.name not in ("line", "source", "left_out", "origin", "readings")
            and (value := getattr(self, item.name)) is not None
        }
        present |= dict(sorted(self.readings.items()))
        return MeasuredFields(
            numbers={name: value for name, value in present.items() if isinstance(value, Tensor)},
            texts={name: value for name, value in present.items() if not isinstance(value, Tensor)},
            line=self.line,
            source=self.source,
            left_out=self.left_out,
            origin=self.origin,
        )

    @staticmethod
    def from_fields(data: MeasuredFields) -> "Measurements":
        """Make measurements of their fields; the inverse of `as_fields`.

        Raises:
            MeasurementError: the fields do not fit together, or a value cannot be one; the message names the row.
        """
        columns: dict[str, Any] = {**data.numbers, **data.texts}
        built_in = {item.name for item in fields(Measurements)}
        return Measurements(
            **{name: values for name, values in columns.items() if name in built_in},
            readings={name: values for name, values in columns.items() if name not in built_in},
            line=data.line,
            source=data.source,
            left_out=data.left_out,
            origin=data.origin,
        )

    @property
    def file_names(self) -> str:
        """Names of the files, without their folders, with " + " between them; or the source in memory."""
        return " + ".join(Path(name).name for name in dict.fromkeys(self.origin or (self.source,)))

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return self.q.shape[0]

    @property
    def dof(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    def measured(self, kind: Kind) -> Bool[Tensor, " rows"]:
        """Say for every row whether it holds a measurement of a kind; see `pisigma.measurement.fields.Kind`.

        A row with position and orientation is of the kind "pose" and of no other.
        """
        return self.as_fields().measured(kind)

    @property
    def kinds(self) -> frozenset[Kind]:
        """What was measured in any of the rows; empty where nothing was."""
        return frozenset(kind for kind in (*KINDS, *READINGS) if bool(self.measured(kind).any()))

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

    def at(self, row: int, column: str | None = None) -> RowPlace:
        """Return the place of a row (from 0), for the `at` of an exception: file and line, or source and row."""
        return self.as_fields().at(row, column)

    def place(self, row: int) -> str:
        """Return the place of a row as a text; see `at`."""
        return self.as_fields().label(row)

    def split_sets(self) -> "tuple[Measurements, Measurements | None]":
        """Split the rows by the column `set`: those to train on, and those of the set "test", which are kept apart.

        Returns:
            The rows to train on, and the others; None where there are none.

        Raises:
            MeasurementError: all rows are of the set "test", or the two rows of a pair are in different sets.
        """
        test = torch.tensor([name == "test" for name in self.split or ()], dtype=torch.bool)
        if not test.any():
            return self, None
        if test.all():
            raise MeasurementError(
                f"{self.source}: column 'set' marks all {self.rows} rows as 'test', so nothing is left to train on; "
                "mark some as 'train' or remove the column."
            )
        return self.select(~test), self.select(test)

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
        return Measurements.from_fields(self.as_fields().select(index))

    def content_hash(self) -> str:
        """SHA-256 (hexadecimal) of the values, wherever they came from: equal values, equal hash."""
        digest = hashlib.sha256()
        data = self.as_fields()
        order = [item.name for item in fields(self)] + sorted(self.readings)
        for name in order:
            if name in data.numbers:
                array = data.numbers[name].detach().cpu().numpy().astype("<f8") + 0.0  # -0.0 becomes 0.0
                array[np.isnan(array)] = np.nan  # there are many NaN, one is enough
                digest.update(f"{name} {array.shape}:".encode() + array.tobytes())
            elif name in data.texts:
                digest.update(f"{name}:{json.dumps(data.texts[name])}".encode())
        return digest.hexdigest()

    @staticmethod
    def read_csv(
        path: str | os.PathLike[str], robot: Robot | None = None, on_bad_row: OnBadRow = "error"
    ) -> "Measurements":
        """Read a CSV file; units come from the column names. See `pisigma.measurement.csv.reading.read_fields`.

        Args:
            path: the file.
            robot: checks number, units and limits of the joints and, where these are coupled, turns the controller's
                values in the file into theirs; None takes the values as they stand.
            on_bad_row: "error", or "leave_out" to go on without it and to report it in `left_out`.

        Raises:
            MeasurementError: the file or a row cannot be used; the message names file, line and column.
        """
        return Measurements.from_fields(read_fields(path, robot, on_bad_row))

    def write_csv(
        self, path: str | os.PathLike[str], robot: Robot | None = None, revolute: Sequence[bool] | None = None
    ) -> None:
        """Write a CSV file that `read_csv` reads back: degrees and millimetres with every digit, and quaternions.

        The file is put in its place in one step when it is complete. Read back it gives the same values to 1e-12
        relative (a rotation, where it is orthonormal to that).

        Args:
            path: the file; written whole or not at all.
            robot: says which joints turn (degrees) and which slide (millimetres); of coupled joints the controller's
                values are written.
            revolute: the same per joint, without a robot; with neither, all joints turn.

        Raises:
            MeasurementError: the measurements would not read back: no row, a row in which nothing was measured,
                a name that a CSV cell cannot hold, or joints that do not fit.
            OutputError: the file cannot be written there.
        """
        origin = "'revolute'" if robot is None else f"robot '{robot.name}'"
        turning = (True,) * self.dof if revolute is None else tuple(revolute)
        turning = turning if robot is None else robot.revolute
        written = self.as_fields()
        if len(turning) != self.dof:
            raise MeasurementError(
                f"{self.source}: has {self.dof} joints, but {origin} has {len(turning)}; give the robot that was "
                "measured."
            )
        if robot is not None and robot.coupling is not None:
            values = {"q": robot.to_controller(self.q)}
            if self.approach is not None:
                values["approach"] = robot.coupling.approach_to_controller(self.approach)
            written = replace(written, numbers={**written.numbers, **values})
            turning = tuple(axis.type == "revolute" for axis in robot.axes)
        write_fields(written, path, turning)


def join(
    data: Sequence[Measurements], cleared: Callable[[MeasuredFields], MeasuredFields] = lambda rows: rows
) -> Measurements:
    """Put the rows of several data sets behind each other; what one of them lacks is NaN or "" in its rows.

    Frames, targets, sockets, anchors and pairs of one name are taken for the same.

    Args:
        data: one or more, of robots with equally many joints.
        cleared: what is left of all rows, before it is checked that they fit together.

    Raises:
        MeasurementError: there is no data set, numbers of joints differ, only some of them say which rows are for the
            test, or rows contradict each other.
    """
    if not data:
        raise MeasurementError("join: one or more data sets were wanted, got none.")
    dofs = sorted({one.dof for one in data})
    if len(dofs) > 1:
        raise MeasurementError(
            f"join: data sets of {dofs[0]} and of {dofs[-1]} joints cannot be joined; give those of one robot."
        )
    if len({one.split is None for one in data if one.rows}) > 1:
        raise MeasurementError(
            "join: some data sets have a split and some have none; give it to all or to none."
        )
    return Measurements.from_fields(cleared(joined_fields([one.as_fields() for one in data])))


def with_new_frames(measurements: Measurements, lines: Sequence[int]) -> Measurements:
    """Give the rows from some lines of their file on frames of their own.

    The rows of a frame "A" from line 50 on are in the frame "A from line 50"; of the nameless one, in "from line 50".

    Args:
        measurements: read from a file.
        lines: at which new frames begin, each up to the next one.

    Raises:
        MeasurementError: a line lies before the second or behind the last row, or rows that belong together (of a pair,
            a socket or an anchor) would be in two frames.
    """
    if not lines:
        return measurements
    if measurements.origin:
        raise MeasurementError(
            f"{measurements.source}: lines at which new frames begin are those of one file, but there are several; "
            "name the frames in a column 'frame'."
        )
    rows = sorted(measurements.line)
    for line in lines:
        if not rows[0] < line <= rows[-1]:
            raise MeasurementError(
                f"{measurements.source}: a new frame at line {line} was asked for, but the rows stand in the lines "
                f"{rows[0]} to {rows[-1]}; give a line behind the first one, as an editor counts them."
            )
    starts = [max((start for start in lines if start <= line), default=0) for line in measurements.line]
    names = [
        f"{name} from line {start}".lstrip() if start else name
        for name, start in zip(measurements.frame, starts, strict=True)
    ]
    return replace(measurements, frame=tuple(names))
