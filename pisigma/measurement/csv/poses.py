"""Read desired poses from CSV files of any length."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice
from typing import TextIO

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place, choice_remedy
from pisigma.files.input_file import open_input
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY, Column, find_column, quoted_names
from pisigma.measurement.csv.header import check_separators
from pisigma.measurement.csv.rows import QUATERNION_TOLERANCE
from pisigma.measurement.csv.table import content_lines, header_names, split_line
from pisigma.measurement.faults import Fault
from pisigma.measurement.fields import UnusableRow
from pisigma.measurement.readings import to_si
from pisigma.robot.row import MAX_MAGNITUDE
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_zyx, transform

CHUNK_ROWS = 20_000
"""Number of rows that are in memory at a time."""

_RPY_COLUMNS = tuple(f"{name}_deg" for name in RPY)
_POSITION_COLUMNS = tuple(f"{name}_mm" for name in POSITION)
_MAX_SHOWN, _MAX_LINE = 40, 10_000_000
"""Largest numbers of characters of a cell that messages show, and of a line."""


@dataclass(frozen=True, eq=False)
class PoseChunk:
    """Some or all of the rows in a file of poses.

    Attributes:
        T: T_base_tool [m] of the valid rows.
        line: line numbers of the valid rows.
        invalid_rows: invalid rows, with their faults.
        read_fraction: fraction of the file that has been read, 0 to 1; NaN if the length of the file is unknown.
    """

    T: Float64[Tensor, "rows 4 4"]
    line: tuple[int, ...]
    invalid_rows: tuple[UnusableRow, ...]
    read_fraction: float


def read_poses(path: str | os.PathLike[str]) -> PoseChunk:
    """Read desired poses: `x_mm,y_mm,z_mm` (or `_m`) with `roll_deg,pitch_deg,yaw_deg` or `qx,qy,qz,qw`.

    Raises:
        MeasurementError: the file, a column or a cell cannot be used; `file`, `line` and `column` state which.
    """
    T: list[Tensor] = []
    lines: list[int] = []
    for chunk in read_pose_chunks(path):
        for bad in chunk.invalid_rows:
            raise bad.error(str(path))
        T.append(chunk.T)
        lines.extend(chunk.line)
    return PoseChunk(torch.cat(T), tuple(lines), invalid_rows=(), read_fraction=1.0)


def read_pose_chunks(path: str | os.PathLike[str], rows: int = CHUNK_ROWS) -> Iterator[PoseChunk]:
    """Read desired poses in chunks of rows; invalid rows are reported, and reading continues.

    For the columns see `read_poses`. Blank lines and lines that start with # are skipped.

    Args:
        path: the file.
        rows: number of rows per chunk.

    Raises:
        MeasurementError: the file cannot be read, its header cannot be used, or it has no rows.
    """
    try:
        with open(path, encoding="utf-8-sig", errors="surrogateescape", opener=open_input) as file:
            yield from _chunks(file, str(path), rows)
    except OSError as problem:
        what = f"the file cannot be read: {problem.strerror}"
        raise MeasurementError(what, at=Place(str(path)), remedy="check the path") from None


def _chunks(file: TextIO, source: str, rows: int) -> Iterator[PoseChunk]:
    length = os.fstat(file.fileno()).st_size
    content = content_lines(_bounded_lines(file, source), source)
    header_line, header = next(content)
    layout = _Layout.from_header(header, Place(source, header_line))
    any_row = False
    while some := list(islice(content, rows)):
        any_row = True
        values, faults = layout.values([line for _, line in some])
        T, sound = layout.poses(values, faults)
        yield PoseChunk(
            T=T[sound],
            line=tuple(number for (number, _), good in zip(some, sound.tolist(), strict=True) if good),
            invalid_rows=tuple(
                UnusableRow.from_fault(some[row][0], fault) for row, fault in sorted(faults.items())
            ),
            read_fraction=file.buffer.tell() / length if length else float("nan"),
        )
    if not any_row:
        raise MeasurementError(
            "the file ends after its header", at=Place(source, header_line), remedy="add one row per pose"
        )


def _bounded_lines(file: TextIO, source: str) -> Iterator[str]:
    """Yield the lines of a file, and refuse lines that are longer than `_MAX_LINE` characters."""
    for number in count(1):
        line = file.readline(_MAX_LINE)
        if len(line) == _MAX_LINE:
            raise MeasurementError(
                expected=f"a line of fewer than {_MAX_LINE:,} characters",
                at=Place(source, number),
                remedy="write one line per pose",
            )
        if not line:
            return
        yield line


@dataclass(frozen=True)
class _Layout:
    """The header of a file of poses.

    Attributes:
        names: names of all columns, in order.
        position: indices and meanings of the columns of the position.
        orientation: indices and meanings of the columns of the orientation, in the order of `QUATERNION` or `RPY`.
    """

    names: tuple[str, ...]
    position: tuple[tuple[int, Column], ...]
    orientation: tuple[tuple[int, Column], ...]

    @staticmethod
    def from_header(line: str, place: Place) -> "_Layout":
        """Read the header, which must have every column of a pose once, with lengths in one unit."""
        if _is_foreign(line):
            raise _NOT_UTF8.error(place)
        names = header_names(line.rstrip("\n"), place)
        columns = _columns(names, place)
        orientation = RPY if RPY[0] in columns else QUATERNION
        position, angles = (tuple(columns[name] for name in group) for group in (POSITION, orientation))
        return _Layout(names, position, angles)

    def values(self, lines: Sequence[str]) -> tuple[Float64[np.ndarray, "rows columns"], dict[int, Fault]]:
        """Return the numbers of rows in the file's units, and the faults by row."""
        text = "".join(lines)
        if '"' not in text and "_" not in text:  # Python reads 1_000 as a number
            cells = [line.split(",") for line in lines]
            if all(len(fields) == len(self.names) for fields in cells):
                try:
                    numbers = np.array(list(map(float, chain.from_iterable(cells)))).reshape(len(lines), -1)
                except ValueError:
                    pass
                else:
                    if np.abs(numbers).max(initial=0.0) <= MAX_MAGNITUDE:  # NaN is refused as well
                        return numbers, {}
        return self._checked_values(lines)

    def _checked_values(self, lines: Sequence[str]) -> tuple[np.ndarray, dict[int, Fault]]:
        """Return numbers and faults like `values`, converting row by row because at least one row has a fault."""
        numbers, faults = np.full((len(lines), len(self.names)), np.nan), {}
        for row, line in enumerate(lines):
            fields, problem = split_line(line.rstrip("\n"))
            if fault := self._fault(line, fields, problem):
                faults[row] = fault
            else:
                numbers[row] = [_number(cell) for cell in fields]
        return numbers, faults

    def _fault(self, line: str, fields: Sequence[str], problem: str) -> Fault | None:
        """Return the fault of a row; None if it has no fault."""
        if _is_foreign(line):
            return _NOT_UTF8
        if problem:
            return Fault(f"the row is not valid CSV: {problem}", remedy="check the quotes")
        if len(fields) != len(self.names):
            remedy = "correct the row (numbers need a decimal point, not a comma)"
            return Fault("", None, f"{len(self.names)} fields", len(fields), remedy)
        for name, cell in zip(self.names, fields, strict=True):
            shown = cell.strip()[:_MAX_SHOWN]
            if not np.isfinite(_number(cell)):
                return Fault("", name, "a finite number", shown, "write one such as -12.5")
            if abs(_number(cell)) > MAX_MAGNITUDE:
                return Fault("", name, f"a value of up to {MAX_MAGNITUDE:g}", shown, "correct the value")
        return None

    def poses(
        self, values: Float64[np.ndarray, "rows columns"], faults: dict[int, Fault]
    ) -> tuple[Float64[Tensor, "rows 4 4"], Bool[Tensor, " rows"]]:
        """Return T_base_tool of valid rows, and their mask; quaternions whose norm is not 1 are added to `faults`."""
        position, angles = (
            torch.from_numpy(np.stack([to_si(values[:, place], column.unit) for place, column in group], -1))
            for group in (self.position, self.orientation)
        )
        if len(self.orientation) == len(QUATERNION):
            length = angles.norm(dim=-1)
            expected = f"a quaternion {', '.join(QUATERNION)} of norm 1"
            for row in ((length - 1).abs() > QUATERNION_TOLERANCE).nonzero()[:, 0].tolist():
                norm = float(f"{float(length[row]):g}")
                faults[row] = Fault("", QUATERNION[0], expected, norm, "normalise it")
            R = rotation_from_quaternion(angles)
        else:
            R = rotation_from_zyx(angles)
        sound = torch.ones(len(values), dtype=torch.bool)
        sound[list(faults)] = False
        return transform(R, position), sound


_NOT_UTF8 = Fault(expected="UTF-8 text", remedy="save the file as CSV in UTF-8")


def _is_foreign(line: str) -> bool:
    """Return whether a line contains bytes that are not UTF-8, which were read as lone surrogates."""
    return not line.isascii() and any("\ud800" <= letter <= "\udfff" for letter in line)


def _number(cell: str) -> float:
    try:
        return np.nan if "_" in cell else float(cell)
    except ValueError:
        return np.nan


def _columns(header: Sequence[str], place: Place) -> dict[str, tuple[int, Column]]:
    """Return index and meaning of every column."""
    valid = (*_POSITION_COLUMNS, *_RPY_COLUMNS, *QUATERNION)
    columns: dict[str, tuple[int, Column]] = {}
    for index, name in enumerate(header):
        column = find_column(name)
        if column is None or column.quantity not in (*POSITION, *RPY, *QUATERNION):
            check_separators(name, place)
            raise MeasurementError(
                expected="a column of a pose",
                value=name,
                at=replace(place, column=name),
                remedy=f"{choice_remedy(name, valid)} Lengths may also be in m.",
            )
        if column.quantity in columns:
            raise MeasurementError(
                f"'{column.quantity}' appears twice", at=replace(place, column=name), remedy="remove one"
            )
        columns[column.quantity] = (index, column)
    _check_whole(columns, place)
    return columns


def _check_whole(columns: dict[str, tuple[int, Column]], place: Place) -> None:
    groups = [group for group in (RPY, QUATERNION) if set(group) & set(columns)]
    if len(groups) > 1:
        raise MeasurementError(
            expected="roll, pitch, yaw or a quaternion",
            value=Phrase("both"),
            at=place,
            remedy="keep one of them",
        )
    orientation = groups[0] if groups else RPY
    for name in (*POSITION, *orientation):
        if name not in columns:
            names = ", ".join((*_POSITION_COLUMNS, *(_RPY_COLUMNS if orientation == RPY else QUATERNION)))
            raise MeasurementError(
                f"the column of '{name}' is missing", at=place, value=name, remedy=f"give {names}"
            )
    lengths = [columns[name][1] for name in POSITION]
    if len({column.unit for column in lengths}) > 1:
        raise MeasurementError(
            expected=f"one unit for {quoted_names(lengths)}",
            value=Phrase(", ".join(column.unit for column in lengths)),
            at=place,
            remedy="use mm or m for all three",
        )
