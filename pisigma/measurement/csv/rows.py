"""The cells of a measurement file: every one checked, every fault with its column."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.measurement.csv.columns import QUATERNION, Column, quoted
from pisigma.measurement.csv.header import Layout
from pisigma.measurement.csv.table import Faults, Table
from pisigma.measurement.readings import READINGS, from_si, to_si
from pisigma.measurement.rules import rows_where
from pisigma.robot import Robot, Row
from pisigma.robot.kinematics.joint_limits import grossly_beyond
from pisigma.robot.row import LARGEST

QUATERNION_TOLERANCE = 1e-3
"""How far the norm of a quaternion may be from 1."""

_Values = Float64[np.ndarray, "rows columns"]

_UNIT_DOUBT = {
    "rad": "check the value, and whether these are degrees in a _rad column",
    "deg": "check the value, its unit and how the controller counts",
    "m": "check the value, and whether these are millimetres in a _m column",
    "mm": "check the value, its unit and how the controller counts",
}


@dataclass(frozen=True, eq=False)
class CheckedRows:
    """The cells of a file, by column.

    Attributes:
        values: numbers in the file's units; NaN where a cell is empty or holds a text.
        cells: the same as text.
        faults: what is wrong with the rows that cannot be used.
    """

    values: Float64[np.ndarray, "rows columns"]
    cells: list[Sequence[str]]
    faults: Faults

    def texts(self, column: int) -> tuple[str, ...]:
        """The texts of a column."""
        return tuple(cell.strip() for cell in self.cells[column])


def check_cells(table: Table, layout: Layout, robot: Robot | None) -> CheckedRows:
    """Turn all cells into values and find those that cannot be used.

    Args:
        table: the file.
        layout: what its header says.
        robot: checks the limits of the joints; None does not check them.
    """
    faults = Faults(table.broken)
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
    """The cells by column; rows of a wrong length are noted and stand there empty."""
    names, wanted = table.header, len(table.header)
    records = table.records
    for row, record in enumerate(records):
        came = len(record)
        if came > wanted:
            what = "remove what is too much (numbers need a decimal point, not a comma)"
            faults.add([(row, f"column {wanted + 1}: {came} fields, but the header has {wanted}; {what}")])
        elif came < wanted:
            what = f"column '{names[came]}': {came} fields, but the header has {wanted}; complete the row"
            faults.add([(row, what)])
    records = [record if len(record) == wanted else [""] * wanted for record in records]
    return list(zip(*records, strict=True))


def _numbers(cells: Sequence[str], column: Column, faults: Faults) -> Float64[np.ndarray, " rows"]:
    """The values of a column in the file's unit, NaN where a cell is empty (and throughout for a text)."""
    if not column.is_number:
        return np.full(len(cells), np.nan)
    try:
        if "_" in "".join(cells):  # Python reads 1_000 as a number
            raise ValueError
        values = np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        values = np.array([_number(cell) for cell in cells])
    remedy = "" if column.joint else ", or leave it empty with all that belongs to it if it was not measured"
    odd = [(row, cell) for row in rows_where(~np.isfinite(values)) if (cell := cells[row].strip())]
    faults.add(
        (row, f"column '{column.name}': '{cell}' is no finite number; write one such as -12.5{remedy}")
        for row, cell in odd
    )
    with np.errstate(invalid="ignore"):
        large = rows_where(np.abs(values) > LARGEST)
    said = f"{column.unit} is more than can be measured; correct it"
    faults.add((row, f"column '{column.name}': {values[row]:.4g} {said}") for row in large)
    return values


def _number(cell: str) -> float:
    """The number in a cell: NaN where it is empty, infinite where it holds anything else."""
    cell = cell.strip()
    try:
        return np.inf if "_" in cell else float(cell) if cell else np.nan
    except ValueError:
        return np.inf


def _check_joints(values: _Values, layout: Layout, robot: Robot | None, faults: Faults) -> None:
    """Every joint value is there and can be one of the joint; see `grossly_beyond`."""
    for number, quantity in enumerate(layout.joints):
        column, q = layout.column(quantity), values[:, layout.index[quantity]]
        empty = f"column '{column.name}': the cell is empty; every row needs all joints"
        faults.add((row, empty) for row in rows_where(np.isnan(q)))
        if robot is not None:
            _check_limits(q, column, robot.axes[number], robot.name, faults)


def _check_limits(
    q: Float64[np.ndarray, " rows"], column: Column, joint: Row, robot: str, faults: Faults
) -> None:
    """The values of one joint are not so far outside its limits that they must be of another unit or joint."""
    outside = grossly_beyond(to_si(q, column.unit), joint)
    lower, upper = from_si(np.array([joint.lower, joint.upper]), column.unit).tolist()
    limits = f"the limits {lower:.6g} to {upper:.6g} {column.unit} of joint '{joint.name}' of robot '{robot}'"
    faults.add(
        (
            row,
            f"column '{column.name}': {q[row]:.10g} {column.unit} is far outside {limits}; {_UNIT_DOUBT[column.unit]}",
        )
        for row in rows_where(outside)
    )


def _check_measured(values: _Values, cells: list[Sequence[str]], layout: Layout, faults: Faults) -> None:
    """Position and orientation are there whole or not at all, something is; quaternions have norm 1."""
    nothing = np.ones(len(values), dtype=bool)
    for quantity in layout.lengths:
        filled = [bool(cell.strip()) for cell in cells[layout.index[quantity]]]
        nothing &= ~np.array(filled, dtype=bool)
    for group in filter(None, (layout.position, layout.orientation)):
        missing = np.isnan(values[:, [layout.index[quantity] for quantity in group]])
        nothing &= missing.all(1)
        _check_whole(missing, [layout.column(quantity) for quantity in group], faults)
    measured = quoted(
        layout.column(quantity) for quantity in (*layout.position, *layout.orientation, *layout.lengths)
    )
    empty = f"columns {measured}: nothing was measured in this row; remove it or fill them"
    faults.add((row, empty) for row in rows_where(nothing))
    if layout.orientation == QUATERNION:
        norm = np.linalg.norm(values[:, [layout.index[quantity] for quantity in QUATERNION]], axis=1)
        four = quoted(layout.column(name) for name in QUATERNION)
        wanted = "where 1 was wanted; check the values and their order x, y, z, w"
        faults.add(
            (row, f"columns {four}: the quaternion has norm {norm[row]:.6g} {wanted}")
            for row in rows_where(np.abs(norm - 1) > QUATERNION_TOLERANCE)
        )


def _check_whole(missing: Bool[np.ndarray, "rows group"], columns: list[Column], faults: Faults) -> None:
    """All cells of a group are filled or none."""
    for row in rows_where(np.asarray(missing.any(1) & ~missing.all(1))):
        first = columns[int(missing[row].argmax())].name
        what = f"the cell is empty, but not all of {quoted(columns)} are; fill all of them or none"
        faults.add([(row, f"column '{first}': {what}")])
