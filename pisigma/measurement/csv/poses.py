"""Wanted poses as a CSV file, of any length."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, count, islice
from typing import TextIO

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, nearest_choice
from pisigma.files.input_file import open_input
from pisigma.measurement.csv.columns import POSITION, QUATERNION, RPY, Column, find_column, quoted
from pisigma.measurement.csv.header import check_separators
from pisigma.measurement.csv.rows import QUATERNION_TOLERANCE
from pisigma.measurement.csv.table import content_lines, header_names, split_line
from pisigma.measurement.fields import LeftOut
from pisigma.measurement.readings import to_si
from pisigma.robot.row import LARGEST
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_rpy, transform

CHUNK_ROWS = 20_000
"""Rows that are in memory at a time."""

_RPY_COLUMNS = tuple(f"{name}_deg" for name in RPY)
_POSITION_COLUMNS = tuple(f"{name}_mm" for name in POSITION)
_LONGEST_CELL, _LONGEST_LINE = 40, 10_000_000


@dataclass(frozen=True, eq=False)
class PoseChunk:
    """Some rows of a file of poses, or all.

    Attributes:
        T: T_base_tool [m] of the rows that are poses.
        line: their lines.
        bad: the other rows and what is wrong with them.
        share: of the file that has been read, 0 to 1; NaN where the file has no length.
    """

    T: Float64[Tensor, "rows 4 4"]
    line: tuple[int, ...]
    bad: tuple[LeftOut, ...]
    share: float


def read_poses(path: str | os.PathLike[str]) -> PoseChunk:
    """Read wanted poses: `x_mm,y_mm,z_mm` (or `_m`) with `roll_deg,pitch_deg,yaw_deg` or `qx,qy,qz,qw`.

    Raises:
        MeasurementError: the file, a column or a cell cannot be used; the message names file, line and
            column.
    """
    T: list[Tensor] = []
    lines: list[int] = []
    for chunk in read_pose_chunks(path):
        for bad in chunk.bad:
            joined = ", " if bad.reason.startswith("column") else ": "
            raise MeasurementError(f"{path}, line {bad.line}{joined}{bad.reason}.")
        T.append(chunk.T)
        lines.extend(chunk.line)
    return PoseChunk(torch.cat(T), tuple(lines), bad=(), share=1.0)


def read_pose_chunks(path: str | os.PathLike[str], rows: int = CHUNK_ROWS) -> Iterator[PoseChunk]:
    """Read wanted poses some rows at a time; a row that is no pose does not stop the others.

    For the columns see `read_poses`. Blank lines and lines that begin with # are skipped.

    Args:
        path: the file.
        rows: at a time.

    Raises:
        MeasurementError: the file cannot be read, its header cannot be used, or no row follows it.
    """
    try:
        with open(path, encoding="utf-8-sig", errors="surrogateescape", opener=open_input) as file:
            yield from _chunks(file, str(path), rows)
    except OSError as problem:
        raise MeasurementError(f"{path}: cannot be read ({problem.strerror}); check the path.") from None


def _chunks(file: TextIO, source: str, rows: int) -> Iterator[PoseChunk]:
    length = os.fstat(file.fileno()).st_size
    content = content_lines(_bounded_lines(file, source), source)
    header_line, header = next(content)
    layout = _Layout.of(header, f"{source}, line {header_line}")
    any_row = False
    while some := list(islice(content, rows)):
        any_row = True
        values, reasons = layout.values([line for _, line in some])
        T, sound = layout.poses(values, reasons)
        yield PoseChunk(
            T=T[sound],
            line=tuple(number for (number, _), good in zip(some, sound.tolist(), strict=True) if good),
            bad=tuple(LeftOut(some[row][0], reasons[row]) for row in sorted(reasons)),
            share=file.buffer.tell() / length if length else float("nan"),
        )
    if not any_row:
        raise MeasurementError(
            f"{source}, line {header_line}: the file ends after its header; add one row per pose."
        )


def _bounded_lines(file: TextIO, source: str) -> Iterator[str]:
    """The lines of a file, none of them so long that it fills the memory."""
    for number in count(1):
        line = file.readline(_LONGEST_LINE)
        if len(line) == _LONGEST_LINE:
            raise MeasurementError(
                f"{source}, line {number}: has more than {_LONGEST_LINE:,} characters; one line per pose was wanted."
            )
        if not line:
            return
        yield line


@dataclass(frozen=True)
class _Layout:
    """The header of a file of poses.

    Attributes:
        names: of all columns, in order.
        position: places and meanings of the columns of the position.
        orientation: the same for the orientation, in the order of `QUATERNION` or `RPY`.
    """

    names: tuple[str, ...]
    position: tuple[tuple[int, Column], ...]
    orientation: tuple[tuple[int, Column], ...]

    @staticmethod
    def of(line: str, place: str) -> "_Layout":
        """Read the header; all of a pose is there, once, and lengths are in one unit."""
        if _is_foreign(line):
            raise MeasurementError(f"{place}: is not UTF-8 text; save the file as CSV in UTF-8.")
        names = header_names(line.rstrip("\n"), place)
        columns = _columns(names, place)
        orientation = RPY if RPY[0] in columns else QUATERNION
        position, angles = (tuple(columns[name] for name in group) for group in (POSITION, orientation))
        return _Layout(names, position, angles)

    def values(self, lines: Sequence[str]) -> tuple[Float64[np.ndarray, "rows columns"], dict[int, str]]:
        """The numbers of rows in the file's units, and what is wrong with which row."""
        text = "".join(lines)
        if '"' not in text and "_" not in text:  # Python reads 1_000 as a number
            cells = [line.split(",") for line in lines]
            if all(len(fields) == len(self.names) for fields in cells):
                try:
                    numbers = np.array(list(map(float, chain.from_iterable(cells)))).reshape(len(lines), -1)
                except ValueError:
                    pass
                else:
                    if np.abs(numbers).max(initial=0.0) <= LARGEST:  # no NaN either
                        return numbers, {}
        return self._checked_values(lines)

    def _checked_values(self, lines: Sequence[str]) -> tuple[np.ndarray, dict[int, str]]:
        """The same row by row, for rows of which one is at fault."""
        numbers, reasons = np.full((len(lines), len(self.names)), np.nan), {}
        for row, line in enumerate(lines):
            fields, problem = split_line(line.rstrip("\n"))
            if reason := self._fault(line, fields, problem):
                reasons[row] = reason
            else:
                numbers[row] = [_number(cell) for cell in fields]
        return numbers, reasons

    def _fault(self, line: str, fields: Sequence[str], problem: str) -> str:
        """What is wrong with a row; "" where nothing is."""
        if _is_foreign(line):
            return "is not UTF-8 text; save the file as CSV in UTF-8"
        if problem:
            return f"is no valid CSV ({problem}); check the quotes"
        if len(fields) != len(self.names):
            return (
                f"{len(self.names)} fields were wanted, got {len(fields)}; correct the row (numbers need a "
                "decimal point, not a comma)"
            )
        for name, cell in zip(self.names, fields, strict=True):
            shown = cell.strip()[:_LONGEST_CELL]
            if not np.isfinite(_number(cell)):
                return f"column '{name}': '{shown}' is no finite number; write one such as -12.5"
            if abs(_number(cell)) > LARGEST:
                return f"column '{name}': {shown} is more than any pose has; correct it"
        return ""

    def poses(
        self, values: Float64[np.ndarray, "rows columns"], reasons: dict[int, str]
    ) -> tuple[Float64[Tensor, "rows 4 4"], Bool[Tensor, " rows"]]:
        """T_base_tool of rows, and which of them are poses; quaternions that are none get a reason."""
        position, angles = (
            torch.from_numpy(np.stack([to_si(values[:, place], column.unit) for place, column in group], -1))
            for group in (self.position, self.orientation)
        )
        if len(self.orientation) == len(QUATERNION):
            length = angles.norm(dim=-1)
            for row in ((length - 1).abs() > QUATERNION_TOLERANCE).nonzero()[:, 0].tolist():
                reasons[row] = (
                    f"columns 'qx' to 'qw': a quaternion of length 1 was wanted, got {float(length[row]):g}; "
                    "normalise it"
                )
            R = rotation_from_quaternion(angles)
        else:
            R = rotation_from_rpy(angles)
        sound = torch.ones(len(values), dtype=torch.bool)
        sound[list(reasons)] = False
        return transform(R, position), sound


def _is_foreign(line: str) -> bool:
    """Whether bytes that are not UTF-8 stand in a line, which were read as lone surrogates."""
    return not line.isascii() and any("\ud800" <= letter <= "\udfff" for letter in line)


def _number(cell: str) -> float:
    try:
        return np.nan if "_" in cell else float(cell)
    except ValueError:
        return np.nan


def _columns(header: Sequence[str], place: str) -> dict[str, tuple[int, Column]]:
    """Place and meaning of every column."""
    valid = (*_POSITION_COLUMNS, *_RPY_COLUMNS, *QUATERNION)
    columns: dict[str, tuple[int, Column]] = {}
    for index, name in enumerate(header):
        column = find_column(name)
        if column is None or column.quantity not in (*POSITION, *RPY, *QUATERNION):
            check_separators(name, place)
            raise MeasurementError(
                f"{place}, column '{name}': no column of a wanted pose; {nearest_choice(name, valid)} Lengths "
                "may be in m and angles in rad."
            )
        if column.quantity in columns:
            raise MeasurementError(f"{place}, column '{name}': '{column.quantity}' stands twice; remove one.")
        columns[column.quantity] = (index, column)
    _check_whole(columns, place)
    return columns


def _check_whole(columns: dict[str, tuple[int, Column]], place: str) -> None:
    groups = [group for group in (RPY, QUATERNION) if set(group) & set(columns)]
    if len(groups) > 1:
        raise MeasurementError(
            f"{place}: roll, pitch, yaw and a quaternion are both there; keep one of them."
        )
    orientation = groups[0] if groups else RPY
    for name in (*POSITION, *orientation):
        if name not in columns:
            wanted = ", ".join((*_POSITION_COLUMNS, *(_RPY_COLUMNS if orientation == RPY else QUATERNION)))
            raise MeasurementError(f"{place}: the column of '{name}' is missing; a pose has {wanted}.")
    lengths = [columns[name][1] for name in POSITION]
    if len({column.unit for column in lengths}) > 1:
        raise MeasurementError(f"{place}, columns {quoted(lengths)}: mixed units; use mm or m for all three.")
