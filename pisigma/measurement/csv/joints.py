"""Joint values of a CSV file, whatever else stands in it."""

import math
import os

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError
from pisigma.measurement.csv.columns import PRISMATIC_UNITS, REVOLUTE_UNITS, Column, find_column, to_si
from pisigma.measurement.csv.table import Table, read_table
from pisigma.robot.description import Robot


def read_joints(path: str | os.PathLike[str], robot: Robot) -> Float64[Tensor, "rows dof"]:
    """Read the columns `q1_deg` or `q1_rad` and so on (prismatic: `q3_mm` or `q3_m`); other columns are not looked at.

    Files of measurements have these columns, and those that `pisigma ik` writes.

    Raises:
        MeasurementError: the file or a joint's cell cannot be used; the message names file, line and column.
    """
    table = read_table(path)
    columns = [_find(table, number, robot) for number in range(robot.dof)]
    found = find_column(f"q{robot.dof + 1}_rad")
    assert found is not None
    more = [name for name in table.header if (column := find_column(name)) and column.joint == found.joint]
    if more:
        raise MeasurementError(
            f"{table.source}, line {table.header_line}, column '{more[0]}': robot '{robot.name}' has {robot.dof} "
            "joints only; give joint values of this robot."
        )
    values = np.empty((len(table.lines), robot.dof))
    for number, column in enumerate(columns):
        place = table.header.index(column.name)
        values[:, number] = to_si(_numbers(table, place), column.unit)
    return torch.from_numpy(values)


def _find(table: Table, number: int, robot: Robot) -> Column:
    """The column of a joint."""
    units = REVOLUTE_UNITS if robot.revolute[number] else PRISMATIC_UNITS
    wanted = [f"q{number + 1}_{unit}" for unit in units]
    there = [name for name in table.header if name in wanted]
    if len(there) != 1:
        what = "is no column" if not there else "are two columns"
        raise MeasurementError(
            f"{table.source}, line {table.header_line}: there {what} for joint '{robot.joints[number].name}' of "
            f"robot '{robot.name}'; give one, {' or '.join(wanted)}."
        )
    column = find_column(there[0])
    assert column is not None
    return column


def _numbers(table: Table, place: int) -> Float64[np.ndarray, " rows"]:
    """The cells of a column as numbers."""
    numbers = []
    for line, fields in zip(table.lines, table.records, strict=True):
        cell = fields[place].strip() if place < len(fields) else ""
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise MeasurementError(
                f"{table.source}, line {line}, column '{table.header[place]}': a number was wanted, got '{cell}'; "
                "give a joint value or remove the row."
            )
    return np.array(numbers)
