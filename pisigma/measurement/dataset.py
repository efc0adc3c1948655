"""Measurements: commanded joint values, and the readings of a sensor at these joint values."""

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

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.csv.columns import write_fields
from pisigma.measurement.csv.reading import read_fields
from pisigma.measurement.faults import RowPlace
from pisigma.measurement.fields import KINDS, Kind, MeasuredFields, OnBadRow, UnusableRow, joined_fields
from pisigma.measurement.readings import READINGS
from pisigma.measurement.rules import check_fields
from pisigma.robot import Robot
from pisigma.robot.se3 import transform

_ORIGIN = ("line", "source", "left_out", "origin", "last_line")
"""Fields that state the origin of the rows."""


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements of a robot in SI units, one per row.

    Values that were not measured in a row are NaN, and missing names are ""; a field that no row has is None. A row
    contains at most one length: a position, a touch, a socket or a distance. It may also contain an orientation. A
    second sensor's reading at the same joint values is a second row.

    Attributes:
        q: commanded joint values [rad or m], with the sign and zero of the controller.
        position: measured position of the target in the row's frame [m].
        rotation: measured rotation of the tool in the row's frame.
        frame: per row, the frame in which the sensor measures; "" if the file names none.
        target: per row, the reflector on the tool that was measured; "" if the file names none.
        sigma_position: per row, standard deviation of the measured length (of every coordinate of a position) [m]; NaN
            if not stated.
        sigma_rotation: per row, standard deviation of a measured angle [rad]; NaN if not stated.
        split: per row, "train" or "test" (column `set`).
        payload: per row, mass of the payload [kg].
        temperature: per row, temperature [deg C].
        socket: per row, the socket in which the target's ball sits; all rows of a socket share one unknown point.
        touch_axis: per row, the axis ("x", "y" or "z") of the row's frame along which the target's tip touched.
        touch: per row, the coordinate at which the tip touched [m].
        distance: per row, distance from the anchor to the target, or between the targets of the two rows of a pair,
            stated in both [m].
        anchor: per row, the fixed point from which the distance is measured; all rows of an anchor share one point and
            one zero offset.
        anchor_place: per row, position of the anchor in the row's frame [m]; NaN if it is to be identified.
        pair: per row, the pair to which it belongs; a pair has exactly two rows, in one frame.
        approach: per row and joint, +1 if the joint value increased before it stopped, -1 if it decreased, NaN if
            unknown.
        torque: per row and joint, torque of the drive towards larger joint values [Nm or N]; NaN if not stated.
        date: per row, the date of the measurement (ISO 8601, such as "2026-11-22"); "" if not stated.
        image: per row, the name of the image from which it was measured; "" if there is no image.
        readings: readings of registered sensors (see `pisigma.measurement.sensors.register_sensor`), by column: one
            number [SI] or one name per row.
        line: per row, the line of the file from which it was read; 0 for rows that were not read from a file.
        source: the file, or a name for the origin of the rows.
        left_out: rows of the file that could not be used, with the reasons.
        origin: per row, the file from which it was read if rows come from several files; otherwise empty.
        last_line: per row, its last line in the file, for images with a line per corner; empty if equal to `line`.

    Raises:
        MeasurementError: the fields do not fit together, or a value is impossible; `column` states the field, and
            `line` or the message the row.
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
    torque: Float64[Tensor, "rows dof"] | None = None
    date: tuple[str, ...] | None = None
    image: tuple[str, ...] | None = None
    readings: Mapping[str, Tensor | tuple[str, ...]] = field(default_factory=dict)
    line: tuple[int, ...] = ()
    source: str = "memory"
    left_out: tuple[UnusableRow, ...] = ()
    origin: tuple[str, ...] = ()
    last_line: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Fill in missing names, and check that the fields fit together."""
        if self.q.ndim != 2 or self.q.shape[1] == 0:
            raise MeasurementError(
                option="q",
                expected="joint values of shape (rows, joints)",
                value=tuple(self.q.shape),
                at=Place(self.source),
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
        """Return the rows by field, without the fields that no row has."""
        return self._fields

    @cached_property
    def _fields(self) -> MeasuredFields:
        present = {
            item.name: value
            for item in fields(self)
            if item.name not in ("readings", *_ORIGIN) and (value := getattr(self, item.name)) is not None
        }
        present |= dict(sorted(self.readings.items()))
        return MeasuredFields(
            numbers={name: value for name, value in present.items() if isinstance(value, Tensor)},
            texts={name: value for name, value in present.items() if not isinstance(value, Tensor)},
            **{name: getattr(self, name) for name in _ORIGIN},
        )

    @staticmethod
    def from_fields(data: MeasuredFields) -> "Measurements":
        """Build measurements from their fields; the inverse of `as_fields`.

        Raises:
            MeasurementError: the fields do not fit together, or a value is impossible; see `Measurements`.
        """
        columns: dict[str, Any] = {**data.numbers, **data.texts}
        built_in = {item.name for item in fields(Measurements)}
        return Measurements(
            **{name: values for name, values in columns.items() if name in built_in},
            readings={name: values for name, values in columns.items() if name not in built_in},
            **{name: getattr(data, name) for name in _ORIGIN},
        )

    @property
    def file_names(self) -> str:
        """Names of the files without folders, joined by " + "; the source for rows that were not read from a file."""
        return " + ".join(Path(name).name for name in dict.fromkeys(self.origin or (self.source,)))

    @property
    def rows(self) -> int:
        """Number of measurements."""
        return self.q.shape[0]

    @property
    def dof(self) -> int:
        """Number of joints."""
        return self.q.shape[1]

    def is_measured(self, kind: Kind) -> Bool[Tensor, " rows"]:
        """Return the mask of the rows that contain a measurement of a kind; see `pisigma.measurement.fields.Kind`.

        A row with a position and an orientation is a "pose" only, neither a "position" nor a "rotation".
        """
        return self.as_fields().is_measured(kind)

    @property
    def kinds(self) -> frozenset[Kind]:
        """Kinds of measurement in any of the rows; empty if nothing was measured."""
        return frozenset(kind for kind in (*KINDS, *READINGS) if bool(self.is_measured(kind).any()))

    @property
    def T(self) -> Float64[Tensor, "rows 4 4"]:
        """Measured poses in the frames of the rows; NaN in rows without a pose.

        Raises:
            MeasurementError: no row has both position and orientation.
        """
        if self.rotation is None or self.position is None:
            lacking = "orientation" if self.rotation is None else "position"
            raise MeasurementError(
                expected="poses",
                value=Phrase(f"no {lacking}"),
                at=Place(self.source),
                remedy="use positions or orientations alone, or measure poses",
            )
        return transform(self.rotation, self.position)

    def place_of(self, row: int, column: str | None = None) -> RowPlace:
        """Return the place of a row (from 0), for the `at` of an exception: file and line, or source and row."""
        return self.as_fields().place_of(row, column)

    def place(self, row: int) -> str:
        """Return the place of a row as text; see `place_of`."""
        return self.as_fields().place_text(row)

    def split_sets(self) -> "tuple[Measurements, Measurements | None]":
        """Split the rows by the column `set` into training rows and held-out rows (the set "test").

        Returns:
            The training rows, and the held-out rows or None if there are none.

        Raises:
            MeasurementError: all rows are in the set "test", or the two rows of a pair are in different sets.
        """
        test = torch.tensor([name == "test" for name in self.split or ()], dtype=torch.bool)
        if not test.any():
            return self, None
        if test.all():
            raise MeasurementError(
                f"all {self.rows} rows are marked as 'test', so no row remains for training",
                value="test",
                at=Place(self.source, column="set"),
                remedy="mark some as 'train' or remove the column",
            )
        return self.select(~test), self.select(test)

    def select(self, index: Tensor) -> "Measurements":
        """Return the rows that an index, in its order, or a mask selects, with all their fields.

        Args:
            index: int64 indices of rows, or one boolean per row.

        Raises:
            MeasurementError: the index is out of range, the mask has a different length, or one row of a pair is
                missing.
        """
        if index.ndim != 1 or index.dtype not in (torch.int64, torch.bool):
            given = f"{index.dtype} of shape {tuple(index.shape)}"
            raise self._index_error("a one-dimensional int64 index or boolean mask", given)
        if index.dtype == torch.bool:
            if index.shape[0] != self.rows:
                raise self._index_error(f"a mask of {self.rows} rows", index.shape[0])
            index = index.nonzero()[:, 0]
        if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < self.rows:
            given = f"{int(index.min())} to {int(index.max())}"
            raise self._index_error(f"rows from 0 to {self.rows - 1}", given)
        return Measurements.from_fields(self.as_fields().select(index))

    def _index_error(self, expected: str, value: str | int) -> MeasurementError:
        return MeasurementError(option="index", expected=expected, value=value, at=Place(self.source))

    def content_hash(self) -> str:
        """Return the SHA-256 (hexadecimal) of all values, which does not depend on the source or on line numbers."""
        digest = hashlib.sha256()
        data = self.as_fields()
        order = [item.name for item in fields(self)] + sorted(self.readings)
        for name in order:
            if name in data.numbers:
                array = data.numbers[name].detach().cpu().numpy().astype("<f8") + 0.0  # -0.0 becomes 0.0
                array[np.isnan(array)] = np.nan  # the bits of NaN differ between platforms
                digest.update(f"{name} {array.shape}:".encode() + array.tobytes())
            elif name in data.texts:
                digest.update(f"{name}:{json.dumps(data.texts[name])}".encode())
        return digest.hexdigest()

    @staticmethod
    def read_csv(
        path: str | os.PathLike[str], robot: Robot | None = None, on_bad_row: OnBadRow = "error"
    ) -> "Measurements":
        """Read a CSV file whose column names state the units; see `pisigma.measurement.csv.reading.read_fields`.

        Args:
            path: the file.
            robot: robot against which number, units and limits of the joints are checked, and which converts the
                controller's values of coupled joints to joint values; None for neither.
            on_bad_row: "error", or "leave_out" to continue without such rows and to list them in `left_out`.

        Raises:
            MeasurementError: the file or a row cannot be used; `file`, `line` and `column` state which.
        """
        return Measurements.from_fields(read_fields(path, robot, on_bad_row))

    def write_csv(
        self, path: str | os.PathLike[str], robot: Robot | None = None, revolute: Sequence[bool] | None = None
    ) -> None:
        """Write a CSV file that `read_csv` reads back: degrees and millimetres with every digit, and quaternions.

        The file is moved to its path in one step when it is complete. Values read back agree to a relative 1e-12
        (rotations only if they are orthonormal to this accuracy).

        Args:
            path: the file; written completely or not at all.
            robot: robot that states which joints are revolute (degrees) or prismatic (millimetres); for coupled joints,
                the controller's values are written.
            revolute: whether each joint is revolute, if no robot is given; if neither is given, all joints are
                revolute.

        Raises:
            MeasurementError: the file could not be read back: there is no row, nothing was measured in a row, a CSV
                cell cannot contain a name, or the number of joints differs from the robot's.
            OutputError: the file cannot be written there.
        """
        origin = "'revolute'" if robot is None else f"robot '{robot.name}'"
        is_revolute = (True,) * self.dof if revolute is None else tuple(revolute)
        is_revolute = is_revolute if robot is None else robot.revolute
        written = self.as_fields()
        if len(is_revolute) != self.dof:
            raise MeasurementError(
                option="revolute" if robot is None else "robot",
                expected=f"{origin} to have the {self.dof} joints of the measurements",
                value=len(is_revolute),
                at=Place(self.source),
                remedy="give the robot that was measured",
            )
        if robot is not None and robot.coupling is not None:
            values = {"q": robot.to_controller(self.q)}
            if self.approach is not None:
                values["approach"] = robot.coupling.approach_to_controller(self.approach)
            written = replace(written, numbers={**written.numbers, **values})
            is_revolute = tuple(axis.type == "revolute" for axis in robot.axes)
        write_fields(written, path, is_revolute)


def join(
    data: Sequence[Measurements], keep_rows: Callable[[MeasuredFields], MeasuredFields] = lambda rows: rows
) -> Measurements:
    """Concatenate data sets; fields that one of them does not have are NaN or "" in its rows.

    Frames, targets, sockets, anchors and pairs of the same name are the same.

    Args:
        data: one or more data sets with the same number of joints.
        keep_rows: function that returns the rows to keep; it is called before the check that rows fit together.

    Raises:
        MeasurementError: there is no data set, the numbers of joints differ, only some data sets have a split, or rows
            contradict each other.
    """
    if not data:
        raise MeasurementError(option="data", expected="one or more data sets", value=Phrase("none"))
    dofs = sorted({one.dof for one in data})
    if len(dofs) > 1:
        raise MeasurementError(
            option="data",
            expected="data sets with the same number of joints",
            value=Phrase(f"{dofs[0]} and {dofs[-1]}"),
            remedy="give data sets of one robot",
        )
    if len({one.split is None for one in data if one.rows}) > 1:
        raise MeasurementError(
            "some data sets have a split (column 'set'), others do not",
            option="data",
            value="split",
            remedy="give the column in all data sets or in none",
        )
    return Measurements.from_fields(keep_rows(joined_fields([one.as_fields() for one in data])))


def with_new_frames(measurements: Measurements, lines: Sequence[int]) -> Measurements:
    """Start new frames at lines of the file, as after the instrument was moved.

    From line 50, for example, rows of the frame "A" get the frame "A from line 50", and rows of the frame "" get "from
    line 50".

    Args:
        measurements: rows of one file.
        lines: first lines of the new frames.

    Raises:
        MeasurementError: a line is before the second or after the last row, or rows that belong together (of a pair, a
            socket or an anchor) would be in two frames.
    """
    if not lines:
        return measurements
    if measurements.origin:
        raise MeasurementError(
            option="lines",
            expected="rows of one file",
            value=measurements.source,
            remedy="name the frames in a column 'frame'",
        )
    rows = sorted(measurements.line)
    for line in lines:
        if not rows[0] < line <= rows[-1]:
            raise MeasurementError(
                option="lines",
                expected=f"a line after the first of the lines {rows[0]} to {rows[-1]} that contain rows",
                value=line,
                at=Place(measurements.source),
                remedy="give a line number as a text editor shows it",
            )
    starts = [max((start for start in lines if start <= line), default=0) for line in measurements.line]
    names = [
        f"{name} from line {start}".lstrip() if start else name
        for name, start in zip(measurements.frame, starts, strict=True)
    ]
    return replace(measurements, frame=tuple(names))
