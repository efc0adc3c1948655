"""Read measurement files, either completely, checking every row, or only their joint values."""

import math
import os
import shlex
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Phrase, Place, check_choice, choice_remedy
from pisigma.measurement.csv.columns import (
    CORNERS,
    PRISMATIC_UNITS,
    QUATERNION,
    REVOLUTE_UNITS,
    Column,
    find_column,
    number_fields,
)
from pisigma.measurement.csv.header import Layout, read_header
from pisigma.measurement.csv.rows import CheckedRows, check_cells
from pisigma.measurement.csv.table import Table, read_table
from pisigma.measurement.fields import TEXTS, MeasuredFields, OnBadRow, UnusableRow
from pisigma.measurement.foreign.export_file import read_export
from pisigma.measurement.foreign.mapping import FileMapping, map_columns
from pisigma.measurement.foreign.quantities import KEYS
from pisigma.measurement.readings import READINGS, text_columns, to_si
from pisigma.measurement.rules import FieldLabels, group_faults, row_faults
from pisigma.robot import Robot
from pisigma.robot.se3 import rotation_from_quaternion, rotation_from_zyx

_MAX_BYTES = 2**22
"""Largest size [bytes] of a refused file that is tested for being an export, so that a refusal does not take long."""


def read_fields(
    path: str | os.PathLike[str], robot: Robot | None = None, on_bad_row: OnBadRow = "error"
) -> MeasuredFields:
    """Read a measurement file, whose header states quantity and unit of every column; columns may be in any order.

    Required are the joint values `q1_deg` or `q1_rad` and so on (prismatic: `q3_mm` or `q3_m`), and at least one kind
    of length (each also in `_m`), of which every row contains at most one: `x_mm,y_mm,z_mm`; `socket`, the name of the
    fixed point in which the ball sits; `touch_axis` (x, y or z) and `touch_mm` with `frame`, the jig; `distance_mm`
    with `anchor`, the name of a fixed point whose position `anchor_x_mm,anchor_y_mm,anchor_z_mm` may be given, or with
    `pair`, a name shared by the two rows between which the distance was measured.

    Optional are `roll_deg,pitch_deg,yaw_deg` (RotZ(roll) · RotY(pitch) · RotX(yaw)) or `qx,qy,qz,qw`, `target`,
    `frame`, `sigma_mm` (standard deviation of the row's length), `sigma_deg`, `set`, `payload_kg`, `temperature_c`,
    `approach1` and so on (+1 if that joint's value increased before it stopped, -1 if it decreased), and `tau_1`
    and so on (torque of that joint's drive in Nm, or its force in N). Registered sensors add further columns. Cells of
    quantities that were not measured are empty.

    Args:
        path: the file.
        robot: robot against which number, units and limits of the joints are checked, and with which the controller's
            values of coupled joints are converted; None for neither.
        on_bad_row: "error" to raise at the first row that cannot be used, "leave_out" to continue without such
            rows and to list them in `left_out`.

    Raises:
        MeasurementError: the file, its header or a row cannot be used; `file`, `line` and `column` state which.
    """
    check_choice(MeasurementError, "on_bad_row", on_bad_row, ("error", "leave_out"))
    try:
        table = read_table(path)
        layout = read_header(table, robot)
    except MeasurementError as problem:
        raise problem.with_text_after(import_hint(path)) from None
    return _complete(_sound_rows(table, layout, robot), on_bad_row)


def fields_of(table: Table, robot: Robot | None = None) -> MeasuredFields:
    """Return the fields in the table of a measurement file; see `read_fields`.

    Raises:
        MeasurementError: the header or a row cannot be used.
    """
    return _complete(read_usable_rows(table, robot), "error")


def read_usable_rows(table: Table, robot: Robot | None) -> MeasuredFields:
    """Return the usable rows of a table, possibly none; all other rows are listed in `left_out`.

    Args:
        table: one row or more.
        robot: see `read_fields`.

    Raises:
        MeasurementError: the header cannot be used.
    """
    return _sound_rows(table, read_header(table, robot), robot)


def _sound_rows(table: Table, layout: Layout, robot: Robot | None) -> MeasuredFields:
    """Check all rows, and return the fields of the rows without a fault."""
    rows = check_cells(table, layout, robot)
    data, labels, faults = _fields(table, layout, rows), _labels(layout), rows.faults
    faults.add(row_faults(data, labels))
    lines = [f"line {line}" for line in table.lines]
    faults.add(group_faults(data, labels, faults.rows_without_faults(data.rows), lines.__getitem__))
    sound = data.select(torch.from_numpy(np.flatnonzero(faults.rows_without_faults(data.rows))))
    numbers = {
        name: values
        for name, values in sound.numbers.items()
        if name == "q" or not bool(values.isnan().all())
    }
    if robot is not None and robot.coupling is not None:
        numbers["q"] = robot.to_dh(numbers["q"])
        if "torque" in numbers:
            raise MeasurementError(
                expected=f"no torques for robot '{robot.name}', whose joints are coupled",
                value=Phrase("tau_1, ..."),
                at=Place(table.source),
                remedy="remove these columns: the torques of the axes are not those of the joints",
            )
        if "approach" in numbers:
            numbers["approach"] = robot.coupling.approach_to_dh(numbers["approach"])
    left_out = tuple(
        UnusableRow.from_fault(table.lines[row], fault) for row, fault in sorted(faults.by_row.items())
    )
    return replace(sound, numbers=numbers, left_out=left_out)


def _complete(data: MeasuredFields, on_bad_row: OnBadRow) -> MeasuredFields:
    """Raise an error for the first fault, stating the number of other faults, unless such rows may be left out."""
    if not data.left_out or (on_bad_row == "leave_out" and data.rows):
        return data
    problem, more = data.left_out[0].error(data.source), len(data.left_out) - 1
    raise problem.with_text_after(
        f" {more} more row{'s have' if more > 1 else ' has'} a fault." if more else ""
    )


def _labels(layout: Layout) -> FieldLabels:
    """Return the column name and the unit that messages use for every field."""
    names = {quantity: layout.column(quantity).name for quantity in layout.index}
    groups = {field.name: field.quantities for field in number_fields() if len(field.quantities) > 1}
    groups |= {sensor: readings.numbers for sensor, readings in READINGS.items()}
    for name, group in groups.items():
        if set(group) <= set(layout.index):
            names[name] = layout.column(group[0]).name
    units = {quantity: layout.column(quantity).unit for quantity in layout.index}
    return FieldLabels(names, units)


def _fields(table: Table, layout: Layout, rows: CheckedRows) -> MeasuredFields:
    """Return the fields of all rows in SI units, including rows with faults."""

    def numbers(*quantities: str) -> Tensor:
        columns = [to_si(rows.values[:, layout.index[name]], layout.column(name).unit) for name in quantities]
        return torch.from_numpy(np.stack(columns, axis=1))

    fields = {"q": numbers(*layout.joints)}
    for field in number_fields():
        if set(field.quantities) <= set(layout.index):
            values = numbers(*field.quantities)
            fields[field.name] = values if len(field.quantities) > 1 else values[:, 0]
    if layout.orientation:
        to_rotation = rotation_from_quaternion if layout.orientation == QUATERNION else rotation_from_zyx
        fields["rotation"] = to_rotation(numbers(*layout.orientation))
    for column in layout.per_joint:
        name, number = column.joint_field
        values = fields.setdefault(name, torch.full_like(fields["q"], torch.nan))
        values[:, number - 1] = numbers(column.quantity)[:, 0]
    names = (*TEXTS, *text_columns())
    texts = {name: rows.texts(layout.index[name]) for name in names if name in layout.index}
    return MeasuredFields(fields, texts, table.lines, table.source)


def read_joints(path: str | os.PathLike[str], robot: Robot) -> Float64[Tensor, "rows dof"]:
    """Read the columns `q1_deg` or `q1_rad` and so on (prismatic: `q3_mm` or `q3_m`), and ignore the others.

    Measurement files and the files that `pisigma ik` writes have these columns. They contain the controller's values,
    which are converted to joint values [rad or m].

    Raises:
        MeasurementError: the file or a joint's cell cannot be used; `file`, `line` and `column` state which.
    """
    table = read_table(path)
    axes = len(robot.axes)
    columns = [_joint_column(table, number, robot) for number in range(axes)]
    more = [name for name in table.header if (column := find_column(name)) and column.joint == axes + 1]
    if more:
        raise MeasurementError(
            expected=f"{axes} joints, as robot '{robot.name}' has",
            value=axes + 1,
            at=replace(table.header_place, column=more[0]),
            remedy="give joint values of this robot",
        )
    values = np.empty((len(table.lines), axes))
    for number, column in enumerate(columns):
        values[:, number] = to_si(number_column(table, column.name), column.unit)
    return torch.from_numpy(robot.to_dh(values))


def contains_measurements(path: str | os.PathLike[str]) -> bool:
    """Return whether a file contains measured values besides joint values, unlike the output of `pisigma ik`.

    Raises:
        MeasurementError: the file cannot be used.
    """
    names = {name.rpartition("_")[0] or name for name in read_table(path).header}
    return bool({"x", "distance", "socket", "u"} & names) and "status" not in names


def _joint_column(table: Table, number: int, robot: Robot) -> Column:
    """Return the column with the values of a joint."""
    axis = robot.axes[number]
    units = REVOLUTE_UNITS if axis.type == "revolute" else PRISMATIC_UNITS
    valid = [f"q{number + 1}_{unit}" for unit in units]
    there = [name for name in table.header if name in valid]
    if len(there) != 1:
        raise MeasurementError(
            expected=f"one column for joint '{axis.name}' of robot '{robot.name}'",
            value=Phrase(" and ".join(there) or "none"),
            at=table.header_place,
            remedy=f"give {' or '.join(valid)}",
        )
    column = find_column(there[0])
    assert column is not None
    return column


def number_column(table: Table, name: str) -> Float64[np.ndarray, " rows"]:
    """Return a column of a table as numbers; no cell may be empty.

    Raises:
        MeasurementError: there is no such column, or a cell is not a number; `line` and `column` state which.
    """
    numbers = []
    for row, cell in enumerate(text_column(table, name)):
        try:
            numbers.append(float(cell))
        except ValueError:
            numbers.append(math.nan)
        if not math.isfinite(numbers[-1]):
            raise MeasurementError(
                expected="a number",
                value=cell,
                at=table.place_of(row, name),
                remedy="give one, or remove the row",
            )
    return np.array(numbers)


def text_column(table: Table, name: str) -> list[str]:
    """Return a column of a table as strings without surrounding spaces.

    Raises:
        MeasurementError: there is no such column.
    """
    if name not in table.header:
        raise MeasurementError(
            "the column is missing",
            at=replace(table.header_place, column=name),
            remedy=choice_remedy(name, table.header),
        )
    index = table.header.index(name)
    return [fields[index].strip() if index < len(fields) else "" for fields in table.records]


def import_hint(path: str | os.PathLike[str]) -> str:
    """Return a sentence with the command that imports a file as an export; "" if there is no such command.

    Args:
        path: a file whose table or header was refused as a measurement file.
    """
    if is_measurement_file(path):
        return ""
    try:
        mapping = map_columns(read_export(path, max_bytes=_MAX_BYTES), {}, None, {})
    except MeasurementError:
        return ""
    is_half = (mapping.has_joints or mapping.has_measured_values) and set(KEYS) & set(mapping.quantities)
    if mapping.left_out_joint_columns or not (
        is_half or (mapping.has_joints and mapping.has_measured_values)
    ):
        return ""
    return f" The command `{_command(mapping)}` would read it as an export."


def is_measurement_file(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is not an export, because its header has columns of measurement files or of corners."""
    try:
        header = read_table(path).header
        return set(CORNERS) <= set(header) or all(find_column(name) or name in CORNERS for name in header)
    except MeasurementError:
        return False


def _command(mapping: FileMapping) -> str:
    words = ["pisigma", "import", shlex.quote(mapping.file.source)]
    if not mapping.has_measured_values:
        words += ["MEASURED", "--join", "point"]
    elif not mapping.has_joints:
        words += ["JOINTS", "--join", "point"]
    if units := mapping.likely_units:
        words += ["--unit", ",".join(units.values())]
    if mapping.ambiguous_encodings:
        words += ["--rotation", "MAKER"]
    return " ".join([*words, "--out", "data.csv"])
