"""Wanted poses as a CSV file."""

import os
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError, nearest_choice
from pisigma.measurement.csv_columns import POSITION, QUATERNION, RPY, Column, find_column, to_si
from pisigma.measurement.csv_table import Table, read_table
from pisigma.se3 import rotation_from_quaternion, rotation_from_rpy, transform

QUATERNION_TOLERANCE = 1e-3


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
        MeasurementError: the file, a column or a cell cannot be used; the message names file, line and column.
    """
    table = read_table(path)
    columns = _columns(table)
    orientation = RPY if RPY[0] in columns else QUATERNION
    numbers = {quantity: _numbers(table, columns[quantity]) for quantity in (*POSITION, *orientation)}
    units = {quantity: columns[quantity][1].unit for quantity in numbers}
    position, angles = (
        torch.from_numpy(np.stack([to_si(numbers[name], units[name]) for name in group], -1))
        for group in (POSITION, orientation)
    )
    if orientation == QUATERNION:
        bad = ((angles.norm(dim=-1) - 1).abs() > QUATERNION_TOLERANCE).nonzero()
        if len(bad):
            line = table.lines[int(bad[0])]
            raise MeasurementError(
                f"{table.source}, line {line}, columns 'qx' to 'qw': a quaternion of length 1 was wanted, got "
                f"{float(angles[int(bad[0])].norm()):g}; normalise it."
            )
    rotation = rotation_from_quaternion(angles) if orientation == QUATERNION else rotation_from_rpy(angles)
    return WantedPoses(transform(rotation, position), table.lines)


def _columns(table: Table) -> dict[str, tuple[int, Column]]:
    """Place and meaning of every column; all of a pose is there, once."""
    place = f"{table.source}, line {table.header_line}"
    valid = ["x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg", *QUATERNION]
    found: dict[str, tuple[int, Column]] = {}
    for index, name in enumerate(table.header):
        column = find_column(name)
        if column is None or column.quantity not in (*POSITION, *RPY, *QUATERNION):
            raise MeasurementError(
                f"{place}, column '{name}': no column of a wanted pose; {nearest_choice(name, valid)}"
            )
        if column.quantity in found:
            raise MeasurementError(f"{place}, column '{name}': stands twice; remove one.")
        found[column.quantity] = (index, column)
    given = [group for group in (RPY, QUATERNION) if set(group) & set(found)]
    if len(given) > 1:
        raise MeasurementError(
            f"{place}: roll, pitch, yaw and a quaternion are both given; keep one of them."
        )
    for name in (*POSITION, *(given[0] if given else RPY)):
        if name not in found:
            raise MeasurementError(
                f"{place}: the column of '{name}' is missing; a pose has {', '.join(valid[:6])}."
            )
    return found


def _numbers(table: Table, place: tuple[int, Column]) -> Float64[np.ndarray, " rows"]:
    index, column = place
    values = np.empty(len(table.lines))
    for row, record in enumerate(table.records):
        where = f"{table.source}, line {table.lines[row]}"
        if row in table.broken or len(record) != len(table.header):
            raise MeasurementError(
                f"{where}: {len(table.header)} fields were wanted, got {len(record)}; correct the row."
            )
        try:
            values[row] = float(record[index])
        except ValueError:
            values[row] = np.nan
        if not np.isfinite(values[row]):
            raise MeasurementError(
                f"{where}, column '{column.name}': a number was wanted, got '{record[index]}'; correct it."
            )
    return values
