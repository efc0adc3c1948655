"""Check every cell of a measurement file; each fault states its column."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.measurement.csv.columns import QUATERNION, Column, quoted_names
from pisigma.measurement.csv.header import Layout
from pisigma.measurement.csv.table import Faults, Table
from pisigma.measurement.faults import Fault
from pisigma.measurement.readings import READINGS, from_si, to_si
from pisigma.measurement.rules import rows_where
from pisigma.robot import Robot, Row
from pisigma.robot.kinematics.joint_limits import far_beyond_limits
from pisigma.robot.row import MAX_MAGNITUDE

QUATERNION_TOLERANCE = 1e-3
"""Largest accepted deviation of the norm of a quaternion from 1."""

_Values = Float64[np.ndarray, "rows columns"]

_UNIT_DOUBT = {
    "rad": "check the value, and whether these are degrees in a _rad column",
    "deg": "check the value, the unit, and the zeros and directions of the controller",
    "m": "check the value, and whether these are millimetres in a _m column",
    "mm": "check the value, the unit, and the zeros and directions of the controller",
}


@dataclass(frozen=True, eq=False)
class CheckedRows:
    """Cells of a file by column, with the faults of rows.

    Attributes:
        values: numbers in the file's units; NaN in empty cells and texts.
        cells: all cells as strings.
        faults: faults of the rows that cannot be used.
    """

    values: Float64[np.ndarray, "rows columns"]
    cells: list[Sequence[str]]
    faults: Faults

    def texts(self, column: int) -> tuple[str, ...]:
        """Return the texts of a column."""
        return tuple(cell.strip() for cell in self.cells[column])


def check_cells(table: Table, layout: Layout, robot: Robot | None) -> CheckedRows:
    """Convert all cells to values, and find the rows that cannot be used.

    Args:
        table: the file.
        layout: its columns.
        robot: robot against which the limits of the joints are checked; None for no check.
    """
    faults = Faults(table.invalid_rows)
    cells = _cells(table, faults)
    values = np.stack([_numbers(cells[i], column, faults) for i, column in enumerate(layout.columns)], axis=1)
    _check_joints(values, layout, robot, faults)
    with np.errstate(over="ignore"):
        _check_measured(values, cells, layout, faults)
    for readings in READINGS.values():
        if set(readings.numbers) <= set(layout.index):
            columns = [layout.column(name) for name in readings.numbers]
            _check_whole(
                np.isnan(values[:, [layout.index[name] for name in readings.numbers]]), columns, faults
            )
    return CheckedRows(values, cells, faults)


def _cells(table: Table, faults: Faults) -> list[Sequence[str]]:
    """Return the cells by column; rows of a wrong length get a fault and empty cells."""
    names, count = table.header, len(table.header)
    records = table.records
    for row, record in enumerate(records):
        expected, got = f"{count} fields as in the header", len(record)
        if got > count:
            remedy = "remove the extra fields (numbers need a decimal point, not a comma)"
            faults.add([(row, Fault("", count + 1, expected, got, remedy))])
        elif got < count:
            faults.add([(row, Fault("", names[got], expected, got, "complete the row"))])
    records = [record if len(record) == count else [""] * count for record in records]
    return list(zip(*records, strict=True))


def _numbers(cells: Sequence[str], column: Column, faults: Faults) -> Float64[np.ndarray, " rows"]:
    """Return the values of a column in the file's unit, NaN for empty cells (and for all texts)."""
    if not column.is_number:
        return np.full(len(cells), np.nan)
    try:
        if "_" in "".join(cells):  # Python reads 1_000 as a number
            raise ValueError
        values = np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        values = np.array([_number(cell) for cell in cells])
    empty = (
        ""
        if column.joint
        else ", or leave it and the other cells of this quantity empty if it was not measured"
    )
    remedy = f"write one such as -12.5{empty}"
    faults.add(
        (row, Fault("", column.name, "a finite number", cell, remedy))
        for row in rows_where(~np.isfinite(values))
        if (cell := cells[row].strip())
    )
    with np.errstate(invalid="ignore"):
        large = rows_where(np.abs(values) > MAX_MAGNITUDE)
    expected = f"a value of up to {MAX_MAGNITUDE:g} {column.unit}".rstrip()
    faults.add(
        (row, Fault("", column.name, expected, float(values[row]), "correct the value")) for row in large
    )
    return values


def _number(cell: str) -> float:
    """Return the number in a cell: NaN if it is empty, infinite if it is not a number."""
    cell = cell.strip()
    try:
        return np.inf if "_" in cell else float(cell) if cell else np.nan
    except ValueError:
        return np.inf


def _check_joints(values: _Values, layout: Layout, robot: Robot | None, faults: Faults) -> None:
    """Check that every joint value is present and possible for its joint; see `far_beyond_limits`."""
    for number, quantity in enumerate(layout.joints):
        column, q = layout.column(quantity), values[:, layout.index[quantity]]
        empty = Fault("", column.name, "a joint value", "", "give the values of all joints in every row")
        faults.add((row, empty) for row in rows_where(np.isnan(q)))
        if robot is not None:
            _check_limits(q, column, robot.axes[number], robot.name, faults)


def _check_limits(
    q: Float64[np.ndarray, " rows"], column: Column, joint: Row, robot: str, faults: Faults
) -> None:
    """Check that a joint's values are not so far outside its limits that the unit or the joint must be wrong."""
    outside = far_beyond_limits(to_si(q, column.unit), joint)
    lower, upper = from_si(np.array([joint.lower, joint.upper]), column.unit).tolist()
    limits = f"{lower:.6g} to {upper:.6g} {column.unit}"
    expected = f"a value near the limits {limits} of joint '{joint.name}' of robot '{robot}'"
    faults.add(
        (row, Fault("", column.name, expected, float(f"{q[row]:.10g}"), _UNIT_DOUBT[column.unit]))
        for row in rows_where(outside)
    )


def _check_measured(values: _Values, cells: list[Sequence[str]], layout: Layout, faults: Faults) -> None:
    """Check that position and orientation are complete or empty, that rows have a reading, and that norms are 1."""
    nothing = np.ones(len(values), dtype=bool)
    for quantity in layout.other_measured_quantities:
        filled = [bool(cell.strip()) for cell in cells[layout.index[quantity]]]
        nothing &= ~np.array(filled, dtype=bool)
    for group in filter(None, (layout.position, layout.orientation)):
        missing = np.isnan(values[:, [layout.index[quantity] for quantity in group]])
        nothing &= missing.all(1)
        _check_whole(missing, [layout.column(quantity) for quantity in group], faults)
    measured = quoted_names(
        layout.column(quantity)
        for quantity in (*layout.position, *layout.orientation, *layout.other_measured_quantities)
    )
    empty = Fault("nothing was measured in this row", remedy=f"fill {measured}, or remove the row")
    faults.add((row, empty) for row in rows_where(nothing))
    if layout.orientation == QUATERNION:
        norm = np.linalg.norm(values[:, [layout.index[quantity] for quantity in QUATERNION]], axis=1)
        expected = f"a quaternion {', '.join(QUATERNION)} of norm 1"
        remedy = "check the values and their order x, y, z, w"
        faults.add(
            (row, Fault("", QUATERNION[0], expected, float(f"{norm[row]:.6g}"), remedy))
            for row in rows_where(np.abs(norm - 1) > QUATERNION_TOLERANCE)
        )


def _check_whole(missing: Bool[np.ndarray, "rows group"], columns: list[Column], faults: Faults) -> None:
    """Check that either all cells of a group are filled or none."""
    for row in rows_where(np.asarray(missing.any(1) & ~missing.all(1))):
        first = columns[int(missing[row].argmax())].name
        problem = f"the cell is empty, but not all of {quoted_names(columns)} are"
        faults.add([(row, Fault(problem, first, value="", remedy="fill all of them or none"))])
