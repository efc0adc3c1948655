"""Which rows of a measurement file can be used: every cell checked, every fault with its column."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from pisigma.measurement.csv.header import ANCHOR_PLACE, QUATERNION, Column, Layout, from_si, quoted, to_si
from pisigma.measurement.csv.table import Faults, Table
from pisigma.measurement.lengths import LengthCells, group_faults, row_faults
from pisigma.measurement.readings import READINGS, SensorReadings
from pisigma.robot import Robot, Row

LIMIT_TOLERANCE = 1e-9
"""How far [rad or m] a joint value may lie outside its limits, for rounding."""

LARGEST, SMALLEST_SIGMA = 1e9, 1e-9
"""In the file's units: nothing that is measured is larger, and nothing is measured more exactly."""
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
        faults: what is wrong with the rows that cannot be used, by row.
    """

    values: Float64[np.ndarray, "rows columns"]
    cells: list[Sequence[str]]
    faults: dict[int, str]


def check_rows(table: Table, layout: Layout, robot: Robot | None) -> CheckedRows:
    """Turn all cells into values and find the rows that cannot be used.

    Args:
        table: the file.
        layout: what its header says.
        robot: checks the limits of the joints; None does not check them.
    """
    faults = Faults(table.broken)
    cells = _cells(table, faults)
    values = np.stack([_numbers(cells[i], column, faults) for i, column in enumerate(layout.columns)], axis=1)
    _check_texts(cells, layout, faults)
    _check_joints(values, layout, robot, faults)
    with np.errstate(over="ignore"):
        _check_measured(values, cells, layout, faults)
    _check_optional(values, layout, faults)
    for readings in READINGS.values():
        _check_readings(readings, values, cells, layout, faults)
    lengths = _length_cells(values, cells, layout)
    for rows, describe in row_faults(lengths):
        faults.add(rows, describe)
    _check_equal_rows(values, cells, layout, table, faults)
    lines = [f"line {line}" for line in table.lines]
    for rows, describe in group_faults(lengths, faults.sound(len(values)), lines.__getitem__):
        faults.add(rows, describe)
    return CheckedRows(values, cells, faults.reasons)


def _cells(table: Table, faults: Faults) -> list[Sequence[str]]:
    """The cells by column; rows of a wrong length are noted and stand there empty."""
    names, wanted = table.header, len(table.header)
    records = table.records
    wrong = np.array([len(record) != wanted for record in records])

    def describe(row: int) -> str:
        came = len(records[row])
        if came > wanted:
            return (
                f"column {wanted + 1}: {came} fields, but the header has {wanted}; remove what is too much "
                "(numbers need a decimal point, not a comma)"
            )
        return f"column '{names[came]}': {came} fields, but the header has {wanted}; complete the row"

    faults.add(wrong, describe)
    if wrong.any():
        records = [[""] * wanted if bad else record for bad, record in zip(wrong, records, strict=True)]
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
    odd = ~np.isfinite(values)
    if odd.any():
        odd[odd] = [bool(cells[row].strip()) for row in np.flatnonzero(odd).tolist()]
        remedy = (
            "" if column.joint else ", or leave it empty with all that belongs to it if it was not measured"
        )
        faults.add(
            odd,
            lambda row: (
                f"column '{column.name}': '{cells[row].strip()}' is no finite number; write one such as "
                f"-12.5{remedy}"
            ),
        )
    with np.errstate(invalid="ignore"):
        faults.add(
            np.abs(values) > LARGEST,
            lambda row: (
                f"column '{column.name}': {values[row]:.4g} {column.unit} is more than can be measured; "
                "correct it"
            ),
        )
    return values


def _number(cell: str) -> float:
    """The number in a cell: NaN where it is empty, infinite where it holds anything else."""
    cell = cell.strip()
    try:
        return np.inf if "_" in cell else float(cell) if cell else np.nan
    except ValueError:
        return np.inf


def _check_texts(cells: list[Sequence[str]], layout: Layout, faults: Faults) -> None:
    """The column set holds train and test only."""
    if "set" in layout.index:
        texts = [cell.strip() for cell in cells[layout.index["set"]]]
        faults.add(
            np.array([text not in ("train", "test") for text in texts]),
            lambda row: (
                f"column 'set': '{texts[row]}' stands where train or test was wanted; write one of them"
            ),
        )


def _check_joints(values: _Values, layout: Layout, robot: Robot | None, faults: Faults) -> None:
    """Every joint value is there and within the robot's limits."""
    for number, quantity in enumerate(layout.joints):
        column, q = layout.column(quantity), values[:, layout.index[quantity]]
        _check_present(q, column, faults)
        if robot is not None:
            _check_limits(q, column, robot.joints[number], robot.name, faults)


def _check_present(q: Float64[np.ndarray, " rows"], column: Column, faults: Faults) -> None:
    """One joint has a value in every row."""
    faults.add(
        np.isnan(q), lambda row: f"column '{column.name}': the cell is empty; every row needs all joints"
    )


def _check_limits(
    q: Float64[np.ndarray, " rows"], column: Column, joint: Row, robot: str, faults: Faults
) -> None:
    """The values of one joint are within its limits."""
    q_si = to_si(q, column.unit)
    outside = (q_si < joint.lower - LIMIT_TOLERANCE) | (q_si > joint.upper + LIMIT_TOLERANCE)
    lower, upper = from_si(np.array([joint.lower, joint.upper]), column.unit).tolist()
    faults.add(
        outside,
        lambda row: (
            f"column '{column.name}': {q[row]:.10g} {column.unit} is outside the limits {lower:.6g} to "
            f"{upper:.6g} {column.unit} of joint '{joint.name}' of robot '{robot}'; "
            f"{_UNIT_DOUBT[column.unit]}"
        ),
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
    faults.add(
        nothing, lambda row: f"columns {measured}: nothing was measured in this row; remove it or fill them"
    )
    if layout.orientation == QUATERNION:
        norm = np.linalg.norm(values[:, [layout.index[quantity] for quantity in QUATERNION]], axis=1)
        faults.add(
            np.abs(norm - 1) > QUATERNION_TOLERANCE,
            lambda row: (
                f"columns {quoted(layout.column(name) for name in QUATERNION)}: the quaternion has norm "
                f"{norm[row]:.6g} where 1 was wanted; check the values and their order x, y, z, w"
            ),
        )


def _check_whole(missing: Bool[np.ndarray, "rows group"], columns: list[Column], faults: Faults) -> None:
    """All cells of a group are filled or none."""
    faults.add(
        np.asarray(missing.any(1) & ~missing.all(1)),
        lambda row: (
            f"column '{columns[int(missing[row].argmax())].name}': the cell is empty, but not all of "
            f"{quoted(columns)} are; fill all of them or none"
        ),
    )


def _check_optional(values: _Values, layout: Layout, faults: Faults) -> None:
    """Standard deviations are measurably above 0, payloads not below."""
    for quantity in ("sigma_position", "sigma_rotation", "payload"):
        if quantity in layout.index:
            _check_sign(values[:, layout.index[quantity]], layout.column(quantity), faults)
    for quantity in layout.approaches:
        _check_approach(values[:, layout.index[quantity]], layout.column(quantity), faults)


def _check_approach(values: Float64[np.ndarray, " rows"], column: Column, faults: Faults) -> None:
    """The direction from which a joint came is +1 or -1 where it is stated."""
    faults.add(
        ~np.isnan(values) & (np.abs(values) != 1),
        lambda row: (
            f"column '{column.name}': {values[row]:.6g} stands where +1 (the joint value grew) or -1 (it fell) was "
            "wanted; correct it or leave the cell empty"
        ),
    )


def _check_sign(values: Float64[np.ndarray, " rows"], column: Column, faults: Faults) -> None:
    """The values of one column are above 0, or not below for a payload."""
    zero_too = column.quantity == "payload"
    wanted = "0 or more" if zero_too else f"{SMALLEST_SIGMA:g} or more"
    faults.add(
        values < (0 if zero_too else SMALLEST_SIGMA),
        lambda row: (
            f"column '{column.name}': {values[row]:.6g} stands where {wanted} was wanted; correct it or "
            "leave the cell empty"
        ),
    )


def _check_readings(
    readings: SensorReadings, values: _Values, cells: list[Sequence[str]], layout: Layout, faults: Faults
) -> None:
    """The readings of a registered sensor are there whole or not at all, and can be."""
    if not {column.name for column in readings.columns} <= set(layout.index):
        return
    columns = [layout.column(name) for name in readings.numbers]
    numbers = values[:, [layout.index[name] for name in readings.numbers]]
    _check_whole(np.isnan(numbers), columns, faults)
    texts = {name: _names(cells, layout, name) for name in readings.texts}
    si = {column.quantity: to_si(numbers[:, k], column.unit) for k, column in enumerate(columns)}
    for rows, describe in readings.row_faults({**si, **texts}):
        faults.add(rows, lambda row, describe=describe: f"columns {quoted(columns)}: {describe(row)}")  # type: ignore[misc]


def _check_equal_rows(
    values: _Values,
    cells: list[Sequence[str]],
    layout: Layout,
    table: Table,
    faults: Faults,
) -> None:
    """No two rows are equal in all columns; the later one is at fault."""
    texts = [
        [cell.strip() for cell in cells[i]] for i, column in enumerate(layout.columns) if not column.is_number
    ]
    first = first_of_equal_rows(values, texts)
    faults.add(
        faults.sound(len(values)) & (first != np.arange(len(values))),
        lambda row: (
            f"all columns: the row equals line {table.lines[first[row]]}; remove one of them "
            "(a repeated measurement has other readings)"
        ),
    )


def first_of_equal_rows(values: _Values, texts: Sequence[Sequence[str]]) -> Int64[np.ndarray, " rows"]:
    """For every row, the first row that equals it in all values (NaN equals NaN) and texts."""
    canonical = np.ascontiguousarray(np.where(np.isnan(values), np.nan, values + 0.0))
    keys = zip(
        canonical.view(f"V{canonical.itemsize * canonical.shape[1]}")[:, 0].tolist(), *texts, strict=True
    )
    first: dict[tuple[object, ...], int] = {}
    return np.array([first.setdefault(key, row) for row, key in enumerate(keys)], dtype=np.int64)


def _length_cells(
    values: Float64[np.ndarray, "rows columns"], cells: list[Sequence[str]], layout: Layout
) -> LengthCells:
    """The cells of a file as the rules for lengths want them, in the file's units."""
    rows = len(values)

    def numbers(quantity: str) -> Float64[np.ndarray, " rows"]:
        return values[:, layout.index[quantity]] if quantity in layout.index else np.full(rows, np.nan)

    def names(quantity: str) -> tuple[str, ...]:
        return _names(cells, layout, quantity) if quantity in layout.index else ("",) * rows

    others = {}
    for sensor, readings in READINGS.items():
        if readings.is_length:
            others[sensor] = ~np.isnan(np.stack([numbers(name) for name in readings.numbers])).any(0)
    labels = {quantity: f"column '{layout.column(quantity).name}'" for quantity in layout.index}
    for name, group in (("position", layout.position), ("anchor_place", ANCHOR_PLACE)):
        if set(group) <= set(layout.index):
            labels[name] = f"columns {quoted(layout.column(quantity) for quantity in group)}"
    labels |= {sensor: f"columns of '{sensor}'" for sensor in others}
    labels["sigma"] = labels.get("sigma_position", "sigma_mm")
    position = np.zeros(rows, dtype=bool)
    if layout.position:
        position = ~np.isnan(np.stack([numbers(name) for name in layout.position], axis=1)).any(1)
    return LengthCells(
        labels=labels,
        frame=names("frame"),
        socket=names("socket"),
        touch_axis=names("touch_axis"),
        anchor=names("anchor"),
        pair=names("pair"),
        position=position,
        touch=numbers("touch"),
        distance=numbers("distance"),
        anchor_place=np.stack([numbers(name) for name in ANCHOR_PLACE], axis=1),
        sigma=numbers("sigma_position"),
        others=others,
    )


def _names(cells: list[Sequence[str]], layout: Layout, quantity: str) -> tuple[str, ...]:
    """The texts of a quantity that the file has."""
    return tuple(cell.strip() for cell in cells[layout.index[quantity]])
