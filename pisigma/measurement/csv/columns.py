"""Columns of measurement files: names, quantities, units, the fields that the columns form, and writing them."""

import csv
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import MeasurementError, Place, choice_remedy
from pisigma.files.output_file import write_atomically
from pisigma.measurement.fields import KINDS, TEXTS, MeasuredFields
from pisigma.measurement.readings import READINGS, Unit, from_si, text_columns
from pisigma.robot.se3 import quaternion_from_rotation

POSITION = ("x", "y", "z")
RPY = ("roll", "pitch", "yaw")
QUATERNION = ("qx", "qy", "qz", "qw")
ANCHOR_PLACE = ("anchor_x", "anchor_y", "anchor_z")

REVOLUTE_UNITS: tuple[Unit, ...] = ("deg", "rad")
PRISMATIC_UNITS: tuple[Unit, ...] = ("mm", "m")
_METRES = {"metres": 1.0, "millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
MISNAMED_UNITS = tuple(
    (_METRES[are] / _METRES[named], are, named) for are in _METRES for named in _METRES if are != named
)
"""Factors on lengths whose unit is stated wrongly: factor, actual unit, stated unit."""

CORNERS = ("corner", "u_px", "v_px")
"""Required columns of files of corners, which `pisigma.measurement.camera` reads."""

PLAN_COLUMNS = ("order", "candidate")
"""Columns of a plan; measurement files may contain them, but they are ignored."""

_JOINT = re.compile(r"q([1-9][0-9]{0,2})_(deg|rad|mm|m)")
PER_JOINT = {"approach": "approach", "torque": "tau_"}
"""Fields with a value per joint, and the prefixes of their columns' names, which the number of the joint follows."""
_PER_JOINT = re.compile(rf"({'|'.join(PER_JOINT.values())})([1-9][0-9]{{0,2}})")


@dataclass(frozen=True)
class Column:
    """A column of a measurement file.

    Attributes:
        name: name in the header, such as "q1_deg".
        quantity: quantity of the column, such as "q1"; unique within a file.
        unit: unit of the values; "" for dimensionless values and texts.
    """

    name: str
    quantity: str
    unit: Unit

    @property
    def is_number(self) -> bool:
        """Whether the cells of the column are numbers."""
        return self.quantity not in (*TEXTS, *PLAN_COLUMNS, *text_columns())

    @property
    def joint(self) -> int:
        """Number of the joint whose value the column contains, from 1; 0 for other columns."""
        match = _JOINT.fullmatch(self.name)
        return int(match[1]) if match else 0

    @property
    def joint_field(self) -> tuple[str, int]:
        """Field of `PER_JOINT` and number of the joint, from 1, whose value it contains; 0 for other columns."""
        match = _PER_JOINT.fullmatch(self.name)
        if match is None:
            return "", 0
        return next(name for name, start in PER_JOINT.items() if start == match[1]), int(match[2])


@dataclass(frozen=True)
class FileField:
    """A numeric field of measurements, and the columns that contain it in files.

    Attributes:
        name: name of the field.
        quantities: quantities of the columns, one for every value of a row.
        units: valid units of the columns; files are written in the first unit.
        column: name, without the unit, of the field's only column, if it differs from the quantity.
    """

    name: str
    quantities: tuple[str, ...]
    units: tuple[Unit, ...]
    column: str = ""

    @property
    def columns(self) -> tuple[Column, ...]:
        """All columns that the field may have, starting with the columns in the first unit."""
        return tuple(
            Column("_".join(filter(None, (self.column or quantity, unit))), quantity, unit)
            for unit in self.units
            for quantity in self.quantities
        )


_FIELDS = (
    FileField("position", POSITION, PRISMATIC_UNITS),
    FileField("touch", ("touch",), PRISMATIC_UNITS),
    FileField("distance", ("distance",), PRISMATIC_UNITS),
    FileField("anchor_place", ANCHOR_PLACE, PRISMATIC_UNITS),
    FileField("rotation", QUATERNION, ("",)),
    FileField("sigma_position", ("sigma_position",), ("mm",), "sigma"),
    FileField("sigma_rotation", ("sigma_rotation",), ("deg",), "sigma"),
    FileField("payload", ("payload",), ("kg",)),
    FileField("temperature", ("temperature",), ("c",)),
)


def number_fields(dof: int = 0) -> tuple[FileField, ...]:
    """Return the numeric fields after the joint values, in the order of a file; rotations may also be read as `RPY`.

    Args:
        dof: number of joints; if 0, the fields of `PER_JOINT` are not included.
    """
    numbers = range(1, dof + 1)
    per_joint = (
        FileField(name, tuple(f"{start}{number}" for number in numbers), ("",))
        for name, start in PER_JOINT.items()
        if dof
    )
    added = (
        FileField(column.name, (column.name,), column.units)
        for readings in READINGS.values()
        for column in readings.columns
        if not column.is_text
    )
    return (*_FIELDS, *per_joint, *added)


def find_column(name: str) -> Column | None:
    """Return the column of a name, or None if there is no such column."""
    match = _JOINT.fullmatch(name)
    if match:
        unit = next(unit for unit in (*REVOLUTE_UNITS, *PRISMATIC_UNITS) if unit == match[2])
        return Column(name, f"q{match[1]}", unit)
    return Column(name, name, "") if _PER_JOINT.fullmatch(name) else _columns().get(name)


def _columns() -> dict[str, Column]:
    """Return all columns by name, except those of joints."""
    columns = [column for field in number_fields() for column in field.columns]
    columns += [Column(f"{name}_deg", name, "deg") for name in RPY]
    columns += [Column(name, name, "") for name in PLAN_COLUMNS]
    columns += [Column("set" if name == "split" else name, name, "") for name in (*TEXTS, *text_columns())]
    return {column.name: column for column in columns}


def column_choices(name: str) -> str:
    """Return a text that lists the valid columns and the one nearest to an unknown `name`.

    Joint columns are listed for one joint only: the joint that `name` seems to refer to, otherwise the first.
    """
    number = re.match(r"[A-Za-z]+[ _]?([1-9][0-9]?)(?![0-9])", name)
    joint = number[1] if number else "1"
    joints = (f"q{joint}_{unit}" for unit in (*REVOLUTE_UNITS, *PRISMATIC_UNITS))
    meant = name.lower()
    if re.fullmatch(r"q[1-9][0-9]?", meant):  # degrees, because most joints are revolute
        meant += "_deg"
    return choice_remedy(meant, (*joints, *_columns(), *(f"{start}{joint}" for start in PER_JOINT.values())))


def quoted_names(columns: Iterable[Column]) -> str:
    """Return the quoted names of columns, joined for messages."""
    return ", ".join(f"'{column.name}'" for column in columns)


def write_fields(data: MeasuredFields, path: str | os.PathLike[str], revolute: Sequence[bool]) -> None:
    """Write a measurement file; see `Measurements.write_csv`.

    Args:
        data: at least one row.
        path: the file; an existing file is replaced.
        revolute: per joint, whether it is revolute (degrees) or prismatic (millimetres).

    Raises:
        MeasurementError: the file could not be read back unchanged.
        OutputError: the file cannot be written there.
    """
    if data.rows == 0:
        raise MeasurementError(
            "there is no row to write", at=Place(data.source), remedy="give at least one measurement"
        )
    numbers = _numbers(data, revolute)
    names = (*TEXTS, *text_columns())
    texts = {"set" if name == "split" else name: data.text(name) for name in names if any(data.text(name))}
    _check(data, texts)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*numbers, *texts])
    cells: list[list[object]] = [
        ["" if number != number else number for number in values.tolist()] for values in numbers.values()
    ]
    writer.writerows(zip(*cells, *texts.values(), strict=True))
    write_atomically(Path(path), text.getvalue())


def _numbers(data: MeasuredFields, revolute: Sequence[bool]) -> dict[str, Float64[np.ndarray, " rows"]]:
    """Return the numeric columns in the file's units, without columns that would be empty.

    The columns of the position are written, even empty, if there is no other length, because the file could not be read
    without them.
    """
    columns: dict[str, Float64[np.ndarray, " rows"]] = {}

    def add(name: str, values: Tensor, unit: Unit, needed: bool = False) -> None:
        if needed or not bool(values.isnan().all()):
            columns[name] = from_si(values.detach().cpu().numpy(), unit)

    for number, (q, is_revolute) in enumerate(zip(data.numbers["q"].T, revolute, strict=True), start=1):
        unit: Unit = "deg" if is_revolute else "mm"
        add(f"q{number}_{unit}", q, unit)
    nothing = torch.full((data.rows, 3), torch.nan, dtype=torch.float64)
    fields = {"position": nothing, **data.numbers}
    if "rotation" in fields:
        fields["rotation"] = quaternion_from_rotation(fields["rotation"])
    alone = not any(bool(data.is_measured(kind).any()) for kind in ("socket", "touch", "distance", *READINGS))
    for field in number_fields(len(revolute)):
        if field.name in fields:
            values = fields[field.name].reshape(data.rows, -1).T
            for column, of_column in zip(field.columns, values, strict=False):
                add(column.name, of_column, column.unit, needed=alone and field.name == "position")
    return columns


def _check(data: MeasuredFields, texts: Mapping[str, Sequence[str]]) -> None:
    """Refuse values that could not be read back unchanged."""
    nothing = ~torch.stack([data.is_measured(kind) for kind in (*KINDS, *READINGS)]).any(0).cpu()
    if bool(nothing.any()):
        raise MeasurementError(
            "nothing was measured in this row",
            at=data.place_of(int(nothing.nonzero()[0])),
            remedy="omit it with select before writing",
        )
    for name, names in texts.items():
        for text in set(names):
            if not _fits_cell(text):
                raise MeasurementError(
                    expected="a name that a CSV cell can contain",
                    value=text,
                    at=data.place_of(names.index(text), name),
                    remedy="use a single line without leading or trailing spaces",
                )


def _fits_cell(text: str) -> bool:
    """Return whether a name can be read back unchanged from a CSV cell."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return False
    return text == text.strip() and not set(text) & {"\n", "\r", "\0"}
