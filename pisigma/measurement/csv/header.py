"""Read the header of a measurement file: find the meaning of its columns, and check that they fit together."""

import math
from dataclasses import dataclass, replace

from pisigma.files.errors import MeasurementError, Place
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
    quoted_names,
)
from pisigma.measurement.csv.table import Table
from pisigma.measurement.readings import READINGS, numeric_columns
from pisigma.robot import Robot


@dataclass(frozen=True)
class Layout:
    """Meaning and order of the columns of a file.

    Attributes:
        columns: meaning of every column, in the order of the file.
        index: index of the column of every quantity, such as {"q1": 0, "x": 6}.
        dof: number of joints.
        orientation: the quantities of the orientation: `RPY`, `QUATERNION` or none.
    """

    columns: tuple[Column, ...]
    index: dict[str, int]
    dof: int
    orientation: tuple[str, ...]

    @property
    def position(self) -> tuple[str, ...]:
        """Quantities of the position, x, y and z; empty if the file has no position."""
        return POSITION if POSITION[0] in self.index else ()

    @property
    def other_measured_quantities(self) -> tuple[str, ...]:
        """Quantities other than position and orientation that make a row a measurement.

        They include names (of sockets and anchors), so that a name without a value is reported.
        """
        return tuple(name for name in ("socket", *_NEEDED, *numeric_columns()) if name in self.index)

    @property
    def joints(self) -> tuple[str, ...]:
        """Quantities of the joint values, q1, q2, ..., in order."""
        return tuple(f"q{number}" for number in range(1, self.dof + 1))

    @property
    def per_joint(self) -> tuple[Column, ...]:
        """Columns with one value per joint, see `PER_JOINT`."""
        return tuple(column for column in self.columns if column.joint_field[1])

    def column(self, quantity: str) -> Column:
        """Return the column of a quantity."""
        return self.columns[self.index[quantity]]


def read_header(table: Table, robot: Robot | None) -> Layout:
    """Determine the meaning of the columns of a file.

    Args:
        table: the file.
        robot: robot against which number and units of the joint columns are checked; None for no check.

    Raises:
        MeasurementError: a column is unknown, missing or duplicate, or units do not fit together.
    """
    place = table.header_place
    if set(CORNERS) <= set(table.header):
        raise MeasurementError(
            "the columns are those of corners of a board in images",
            at=place,
            value=",".join(CORNERS),
            remedy="describe camera and board with --camera camera.yaml --board board.yaml (options of calibrate, "
            "recalibrate, evaluate, verify, monitor, compare and report)",
        )
    columns = tuple(_find(place, name, number) for number, name in enumerate(table.header, start=1))
    index: dict[str, int] = {}
    for number, column in enumerate(columns):
        if column.quantity in index:
            other = columns[index[column.quantity]]
            raise _fault(
                place,
                f"the quantity appears twice, first as '{other.name}' in column {index[column.quantity] + 1}",
                column,
                "remove one of them",
            )
        index[column.quantity] = number
    dof = _check_joints(place, columns)
    if robot is not None:
        _check_robot(place, [columns[index[f"q{number}"]] for number in range(1, dof + 1)], robot)
    _check_joint_fields(place, columns, dof)
    _check_position(place, columns)
    _check_lengths(place, columns)
    _check_readings(place, columns)
    return Layout(columns, index, dof, _check_orientation(place, columns))


def _fault(place: Place, problem: str, column: Column | None, remedy: str) -> MeasurementError:
    """Return the exception for a fault of a header, or of one of its columns."""
    at = place if column is None else replace(place, column=column.name)
    return MeasurementError(problem, at=at, remedy=remedy)


def _find(place: Place, name: str, number: int) -> Column:
    """Return the column of a name in the header."""
    column = find_column(name)
    if column is not None:
        return column
    if not name:
        raise MeasurementError(
            "the column has no name",
            at=replace(place, column=number),
            remedy="name it, or remove the extra comma",
        )
    check_separators(name, place)
    if _is_number(name):
        raise MeasurementError(
            expected="the name of a column",
            value=name,
            at=replace(place, column=number),
            remedy="start the file with the names of its columns, such as q1_deg,q2_deg,x_mm,y_mm,z_mm",
        )
    raise MeasurementError(
        "unknown column", value=name, at=replace(place, column=name), remedy=column_choices(name)
    )


def check_separators(name: str, place: Place) -> None:
    """Refuse a header whose fields are not separated by commas.

    Raises:
        MeasurementError: the fields are not separated by commas.
    """
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if separator in name:
            raise MeasurementError(
                expected="commas between fields",
                value=called,
                at=replace(place, column=name),
                remedy="save the file with commas between fields and decimal points in numbers",
            )


def _is_number(name: str) -> bool:
    try:
        return math.isfinite(float(name))
    except ValueError:
        return False


def _check_joints(place: Place, columns: tuple[Column, ...]) -> int:
    """Check that joints are numbered from q1 without gaps, with one unit per joint type; return their number."""
    joints = sorted((column for column in columns if column.joint), key=lambda column: column.joint)
    if not joints:
        remedy = "add q1_deg or q1_rad (q1_mm or q1_m for a prismatic joint) and so on for every joint"
        raise _fault(place, "there is no joint column", None, remedy)
    for expected, column in enumerate(joints, start=1):
        if column.joint != expected:
            problem = f"the joint before it has no column 'q{expected}_{column.unit}'"
            raise _fault(place, problem, column, "add it, or number the joints from q1 without a gap")
    for units in (REVOLUTE_UNITS, PRISMATIC_UNITS):
        _check_one_unit(place, [column for column in joints if column.unit in units])
    return len(joints)


def _check_one_unit(place: Place, columns: list[Column]) -> None:
    for column in columns:
        if column.unit != columns[0].unit:
            raise MeasurementError(
                expected=f"the unit of '{columns[0].name}', {columns[0].unit}",
                value=column.unit,
                at=replace(place, column=column.name),
                remedy="use one unit for both",
            )


def _check_robot(place: Place, joints: list[Column], robot: Robot) -> None:
    """Check that the joint columns fit the robot's joints."""
    if len(joints) != len(robot.axes):
        raise MeasurementError(
            expected=f"{len(robot.axes)} joints, as robot '{robot.name}' has",
            value=len(joints),
            at=replace(place, column=joints[-1].name),
            remedy="choose the robot that was measured, or correct the columns",
        )
    for column, joint in zip(joints, robot.axes, strict=True):
        units = REVOLUTE_UNITS if joint.type == "revolute" else PRISMATIC_UNITS
        if column.unit not in units:
            raise MeasurementError(
                expected=f"{' or '.join(units)} for the {joint.type} joint '{joint.name}' of robot '{robot.name}'",
                value=column.unit,
                at=replace(place, column=column.name),
                remedy=f"give {' or '.join(f'{column.quantity}_{unit}' for unit in units)}",
            )


def _check_joint_fields(place: Place, columns: tuple[Column, ...], dof: int) -> None:
    """Check that directions of approach and torques belong to joints in the file."""
    for column in columns:
        if column.joint_field[1] > dof:
            raise MeasurementError(
                expected=f"a joint from 1 to {dof}",
                value=column.joint_field[1],
                at=replace(place, column=column.name),
                remedy="correct its number, or remove the column",
            )


def _check_position(place: Place, columns: tuple[Column, ...]) -> None:
    """Check that x, y and z are present in one unit, unless the file has other lengths."""
    present = [column for column in columns if column.quantity in POSITION]
    if not present and {column.quantity for column in columns} & {"socket", *_NEEDED, *numeric_columns()}:
        return
    unit = present[0].unit if present else "mm"
    for quantity in POSITION:
        if quantity not in {column.quantity for column in present}:
            names = ",".join(f"{name}_{unit}" for name in POSITION)
            raise MeasurementError(
                "the column is missing",
                at=replace(place, column=f"{quantity}_{unit}"),
                remedy=f"add the measured position as {names} (leave cells empty where it was not measured)",
            )
    _check_one_unit(place, present)


_NEEDED = {
    "touch": (("touch_axis",), "add the column touch_axis (x, y or z)"),
    "touch_axis": (("touch",), "add the column touch_mm, the coordinate of the touch"),
    "distance": (
        ("anchor", "pair"),
        "add the column anchor (name of a fixed point) or pair (name of two rows)",
    ),
    "anchor": (("distance",), "add the column distance_mm"),
    "pair": (("distance",), "add the column distance_mm"),
}


def _check_lengths(place: Place, columns: tuple[Column, ...]) -> None:
    """Check that every column that requires another one has it."""
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
            raise _fault(place, "the column requires another column", present[quantity], remedy)
    if "touch" in present and "frame" not in present:
        remedy = "add the column frame, the placement of the jig that was touched"
        raise _fault(place, "the column requires the frame of a jig", present["touch"], remedy)
    _check_one_unit(place, [present[name] for name in ANCHOR_PLACE if name in present])


def _check_readings(place: Place, columns: tuple[Column, ...]) -> None:
    """Check that a file has either all columns of a registered sensor or none."""
    present = {column.quantity: column for column in columns}
    for readings in READINGS.values():
        there = [column for column in readings.columns if column.name in present]
        missing = [
            column for column in readings.columns if column.name not in present and not column.is_optional
        ]
        if there and missing:
            names = ", ".join(f"{column.name}_{column.units[0]}".rstrip("_") for column in missing)
            problem = f"the column needs the other columns of the sensor '{readings.sensor}'"
            raise _fault(place, problem, present[there[0].name], f"add {names}")


def _check_orientation(place: Place, columns: tuple[Column, ...]) -> tuple[str, ...]:
    """Return the quantities of the orientation, which must be complete and appear once."""
    groups = {
        group: [column for column in columns if column.quantity in group] for group in (RPY, QUATERNION)
    }
    if groups[RPY] and groups[QUATERNION]:
        first, second = quoted_names(groups[RPY]), quoted_names(groups[QUATERNION])
        problem = f"the orientation appears twice, as {first} and as {second}"
        remedy = "keep roll, pitch, yaw or the quaternion"
        raise _fault(place, problem, groups[QUATERNION][0], remedy)
    for group, present in groups.items():
        if not present:
            continue
        missing = [name for name in group if name not in {column.quantity for column in present}]
        if missing:
            unit = "_deg" if group == RPY else ""
            problem = f"the orientation is incomplete, with {quoted_names(present)} only"
            names = ", ".join(name + unit for name in missing)
            raise _fault(place, problem, present[0], f"add {names}")
        return group
    return ()
