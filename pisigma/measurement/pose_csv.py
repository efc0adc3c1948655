"""Wanted poses as a CSV file."""

import os
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.csv_columns import POSITION, QUATERNION, RPY, Column, find_column, quoted, to_si
from pisigma.measurement.csv_rows import QUATERNION_TOLERANCE
from pisigma.measurement.csv_table import Table, read_table
from pisigma.se3 import rotation_from_quaternion, rotation_from_rpy, transform

_RPY_COLUMNS = tuple(f"{name}_deg" for name in RPY)
_POSITION_COLUMNS = tuple(f"{name}_mm" for name in POSITION)


@dataclass(frozen=True, eq=False)
class WantedPoses:
    """Poses read from a file.

    Attributes:
        T: T_base_tool [m].
        line: line of every pose in the file.
    """

    T: Float64[Tensor, "rows 4 4"]
    line: tuple[int, ...]


def read_poses(path: str | os.PathLike[str]) -> WantedPoses:
    """Read wanted poses: `x_mm,y_mm,z_mm` (or `_m`) with `roll_deg,pitch_deg,yaw_deg` or `qx,qy,qz,qw`.

    Raises:
        MeasurementError: the file, a column or a cell cannot be used; the message names file, line and
            column.
    """
    table = read_table(path)
    columns = _columns(table)
    orientation = RPY if RPY[0] in columns else QUATERNION
    position, angles = (
        torch.from_numpy(np.stack([_values(table, *columns[name]) for name in group], -1))
        for group in (POSITION, orientation)
    )
    if orientation == RPY:
        return WantedPoses(transform(rotation_from_rpy(angles), position), table.lines)
    bad = ((angles.norm(dim=-1) - 1).abs() > QUATERNION_TOLERANCE).nonzero()
    if len(bad):
        row = int(bad[0])
        raise MeasurementError(
            f"{table.source}, line {table.lines[row]}, columns 'qx' to 'qw': a quaternion of length 1 was "
            f"wanted, got {float(angles[row].norm()):g}; normalise it."
        )
    return WantedPoses(transform(rotation_from_quaternion(angles), position), table.lines)


def _columns(table: Table) -> dict[str, tuple[int, Column]]:
    """Place and meaning of every column; all of a pose is there, once, and lengths are in one unit."""
    place = f"{table.source}, line {table.header_line}"
    valid = (*_POSITION_COLUMNS, *_RPY_COLUMNS, *QUATERNION)
    found: dict[str, tuple[int, Column]] = {}
    for index, name in enumerate(table.header):
        column = find_column(name)
        if column is None or column.quantity not in (*POSITION, *RPY, *QUATERNION):
            raise MeasurementError(
                f"{place}, column '{name}': no column of a wanted pose; {nearest_choice(name, valid)}"
            )
        if column.quantity in found:
            raise MeasurementError(f"{place}, column '{name}': '{column.quantity}' stands twice; remove one.")
        found[column.quantity] = (index, column)
    given = [group for group in (RPY, QUATERNION) if set(group) & set(found)]
    if len(given) > 1:
        raise MeasurementError(
            f"{place}: roll, pitch, yaw and a quaternion are both given; keep one of them."
        )
    orientation = given[0] if given else RPY
    for name in (*POSITION, *orientation):
        if name not in found:
            wanted = ", ".join((*_POSITION_COLUMNS, *(_RPY_COLUMNS if orientation == RPY else QUATERNION)))
            raise MeasurementError(f"{place}: the column of '{name}' is missing; a pose has {wanted}.")
    lengths = [found[name][1] for name in POSITION]
    if len({column.unit for column in lengths}) > 1:
        raise MeasurementError(f"{place}, columns {quoted(lengths)}: mixed units; use mm or m for all three.")
    return found


def _values(table: Table, index: int, column: Column) -> Float64[np.ndarray, " rows"]:
    """The values of a column in SI units."""
    values = np.empty(len(table.lines))
    for row, record in enumerate(table.records):
        where = f"{table.source}, line {table.lines[row]}"
        if row in table.broken:
            raise MeasurementError(f"{where}: is no valid CSV ({table.broken[row]}); check the quotes.")
        if len(record) != len(table.header):
            raise MeasurementError(
                f"{where}: {len(table.header)} fields were wanted, got {len(record)}; correct the row "
                "(numbers need a decimal point, not a comma)."
            )
        cell = record[index].strip()
        try:
            values[row] = np.nan if "_" in cell else float(cell)  # Python reads 1_000 as a number
        except ValueError:
            values[row] = np.nan
        if not np.isfinite(values[row]):
            raise MeasurementError(
                f"{where}, column '{column.name}': '{cell}' is no finite number; write one such as -12.5."
            )
    return to_si(values, column.unit)
