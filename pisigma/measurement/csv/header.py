"""The header of a measurement file: what its columns mean, by their names alone, and whether they fit together."""

import math
from dataclasses import dataclass

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.columns import (
    ANCHOR_PLACE,
    CORNERS,
    POSITION,
    PRISMATIC_UNITS,
    QUATERNION,
    REVOLUTE_UNITS,
    RPY,
    Column,
    column_choices,
    find_column,
    quoted,
)
from pisigma.measurement.csv.table import Table
from pisigma.measurement.readings import READINGS, reading_numbers
from pisigma.robot import Robot


@dataclass(frozen=True)
class Layout:
    """What stands where in the rows of a file.

    Attributes:
        columns: meaning of every column, in the file's order.
        index: place of every quantity, such as {"q1": 0, "x": 6}.
        dof: number of joints.
        orientation: the quantities of the orientation: `RPY`, `QUATERNION` or none.
    """

    columns: tuple[Column, ...]
    index: dict[str, int]
    dof: int
    orientation: tuple[str, ...]

    @property
    def position(self) -> tuple[str, ...]:
        """The quantities x, y, z, or none."""
        return POSITION if POSITION[0] in self.index else ()

    @property
    def lengths(self) -> tuple[str, ...]:
        """The quantities beside position and orientation of which one is enough for a measurement.

        The names are among them, so that a name without its value is complained of as such.
        """
        return tuple(name for name in ("socket", *_NEEDED, *reading_numbers()) if name in self.index)

    @property
    def joints(self) -> tuple[str, ...]:
        """The quantities q1, q2, ... in order."""
        return tuple(f"q{number}" for number in range(1, self.dof + 1))

    @property
    def approaches(self) -> tuple[str, ...]:
        """The quantities approach1, approach2, ... that the file has."""
        return tuple(column.quantity for column in self.columns if column.approach)

    def column(self, quantity: str) -> Column:
        """The column of a quantity."""
        return self.columns[self.index[quantity]]


def read_header(table: Table, robot: Robot | None) -> Layout:
    """Find out what the columns of a file mean.

    Args:
        table: the file.
        robot: checks number and units of the joint columns; None checks neither.

    Raises:
        MeasurementError: a column is unknown, missing or there twice, or units do not fit together.
    """
    place = f"{table.source}, line {table.header_line}"
    if set(CORNERS) <= set(table.header):
        raise MeasurementError(
            f"{place}: these are corners of a board in images; state what they mean with --camera camera.yaml --board "
            "board.yaml, which pisigma calibrate, recalibrate, evaluate, verify, monitor, compare and report read."
        )
    columns = tuple(_find(place, name, number) for number, name in enumerate(table.header, start=1))
    index: dict[str, int] = {}
    for number, column in enumerate(columns):
        if column.quantity in index:
            other = columns[index[column.quantity]]
            raise MeasurementError(
                f"{place}, column '{column.name}': '{other.name}' in column {index[column.quantity] + 1} "
                "gives the same quantity already; remove one of them."
            )
        index[column.quantity] = number
    dof = _check_joints(place, columns)
    if robot is not None:
        _check_robot(place, [columns[index[f"q{number}"]] for number in range(1, dof + 1)], robot)
    _check_approaches(place, columns, dof)
    _check_position(place, columns)
    _check_lengths(place, columns)
    _check_readings(place, columns)
    return Layout(columns, index, dof, _check_orientation(place, columns))


def _find(place: str, name: str, number: int) -> Column:
    """The column of a name in the header."""
    column = find_column(name)
    if column is not None:
        return column
    if not name:
        raise MeasurementError(
            f"{place}, column {number}: has no name; name it or remove the comma too many."
        )
    check_separators(name, place)
    if _is_number(name):
        raise MeasurementError(
            f"{place}, column {number}: a header was wanted, but there is the number {name}; begin the file "
            "with the names of the columns, such as q1_deg,q2_deg,x_mm,y_mm,z_mm."
        )
    raise MeasurementError(f"{place}, column '{name}': unknown column; {column_choices(name)}")


def check_separators(name: str, place: str) -> None:
    """Refuse a header whose fields are not separated by commas.

    Raises:
        MeasurementError: see above.
    """
    if ";" in name or "\t" in name:
        raise MeasurementError(
            f"{place}, column '{name}': fields are separated by semicolons or tabs; save the file with "
            "commas between fields and points in numbers."
        )


def _is_number(name: str) -> bool:
    try:
        return math.isfinite(float(name))
    except ValueError:
        return False


def _check_joints(place: str, columns: tuple[Column, ...]) -> int:
    """Number of joints; q1 to the last are there, in one unit per kind of joint."""
    joints = sorted((column for column in columns if column.joint), key=lambda column: column.joint)
    if not joints:
        raise MeasurementError(
            f"{place}: no joint column; add q1_deg or q1_rad (q1_mm or q1_m for a prismatic joint) and so on per joint."
        )
    for expected, column in enumerate(joints, start=1):
        if column.joint != expected:
            raise MeasurementError(
                f"{place}, column '{column.name}': the joint before it has no column; add "
                f"q{expected}_{column.unit} or number the joints from q1 without a gap."
            )
    for units in (REVOLUTE_UNITS, PRISMATIC_UNITS):
        _check_one_unit(place, [column for column in joints if column.unit in units])
    return len(joints)


def _check_one_unit(place: str, columns: list[Column]) -> None:
    for column in columns:
        if column.unit != columns[0].unit:
            raise MeasurementError(
                f"{place}, column '{column.name}': is in {column.unit}, but '{columns[0].name}' is in "
                f"{columns[0].unit}; use one unit for both."
            )


def _check_robot(place: str, joints: list[Column], robot: Robot) -> None:
    """The joint columns fit the robot's joints."""
    if len(joints) != len(robot.axes):
        raise MeasurementError(
            f"{place}, column '{joints[-1].name}': the file ends with joint {len(joints)}, but robot '{robot.name}' "
            f"has {len(robot.axes)} joints; choose the robot that was measured or correct the columns."
        )
    for column, joint in zip(joints, robot.axes, strict=True):
        units = REVOLUTE_UNITS if joint.type == "revolute" else PRISMATIC_UNITS
        if column.unit not in units:
            choices = " or ".join(f"{column.quantity}_{unit}" for unit in units)
            raise MeasurementError(
                f"{place}, column '{column.name}': joint '{joint.name}' of robot '{robot.name}' is "
                f"{joint.type} and cannot be in {column.unit}; give {choices}."
            )


def _check_approaches(place: str, columns: tuple[Column, ...], dof: int) -> None:
    """Directions of approach are those of joints that the file has."""
    for column in columns:
        if column.approach > dof:
            raise MeasurementError(
                f"{place}, column '{column.name}': the file has the joints q1 to q{dof}; correct its number or remove "
                "the column."
            )


def _check_position(place: str, columns: tuple[Column, ...]) -> None:
    """x, y and z are there, in one unit, unless the file has other lengths."""
    present = [column for column in columns if column.quantity in POSITION]
    if not present and {column.quantity for column in columns} & {"socket", *_NEEDED, *reading_numbers()}:
        return
    unit = present[0].unit if present else "mm"
    for quantity in POSITION:
        if quantity not in {column.quantity for column in present}:
            raise MeasurementError(
                f"{place}: the column '{quantity}_{unit}' is missing; add the measured position as "
                f"{','.join(f'{name}_{unit}' for name in POSITION)} (cells may be empty where it was not measured)."
            )
    _check_one_unit(place, present)


_NEEDED = {
    "touch": (("touch_axis",), "add the column touch_axis (x, y or z)"),
    "touch_axis": (("touch",), "add the column touch_mm, the coordinate that was touched"),
    "distance": (
        ("anchor", "pair"),
        "add the column anchor (name of a fixed point) or pair (name of two rows)",
    ),
    "anchor": (("distance",), "add the column distance_mm"),
    "pair": (("distance",), "add the column distance_mm"),
}


def _check_lengths(place: str, columns: tuple[Column, ...]) -> None:
    """Columns that say nothing without another one have it."""
    present = {column.quantity: column for column in columns}
    needed = dict(_NEEDED)
    for name in ANCHOR_PLACE:
        others = tuple(other for other in ANCHOR_PLACE if other not in present)
        if name in present and others:
            needed[name] = (others, f"add {', '.join(f'{other}_{present[name].unit}' for other in others)}")
        elif name in present:
            needed[name] = (("anchor",), "add the column anchor, its name")
    for quantity, (others, remedy) in needed.items():
        if quantity in present and not set(others) & set(present):
            raise MeasurementError(
                f"{place}, column '{present[quantity].name}': says nothing without another column; {remedy}."
            )
    if "touch" in present and "frame" not in present:
        raise MeasurementError(
            f"{place}, column '{present['touch'].name}': says nothing without the frame of a jig; add the column "
            "frame, which placement of the jig was touched."
        )
    _check_one_unit(place, [present[name] for name in ANCHOR_PLACE if name in present])


def _check_readings(place: str, columns: tuple[Column, ...]) -> None:
    """All columns of a registered sensor are there, or none."""
    present = {column.quantity: column for column in columns}
    for readings in READINGS.values():
        there = [column for column in readings.columns if column.name in present]
        missing = [
            column for column in readings.columns if column.name not in present and not column.is_optional
        ]
        if there and missing:
            wanted = ", ".join(f"{column.name}_{column.units[0]}".rstrip("_") for column in missing)
            raise MeasurementError(
                f"{place}, columns {quoted(present[column.name] for column in there)}: say nothing without the other "
                f"columns of the sensor '{readings.sensor}'; add {wanted}."
            )


def _check_orientation(place: str, columns: tuple[Column, ...]) -> tuple[str, ...]:
    """The form in which the file gives the orientation, whole and only once."""
    groups = {
        group: [column for column in columns if column.quantity in group] for group in (RPY, QUATERNION)
    }
    if groups[RPY] and groups[QUATERNION]:
        raise MeasurementError(
            f"{place}, columns {quoted(groups[RPY])} and {quoted(groups[QUATERNION])}: the orientation "
            "stands twice; keep roll, pitch, yaw or the quaternion."
        )
    for group, present in groups.items():
        if not present:
            continue
        missing = [name for name in group if name not in {column.quantity for column in present}]
        if missing:
            unit = "_deg" if group == RPY else ""
            raise MeasurementError(
                f"{place}, columns {quoted(present)}: the orientation is incomplete; add "
                f"{', '.join(name + unit for name in missing)}."
            )
        return group
    return ()
