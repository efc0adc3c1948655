"""What an error source is: a section of a recipe that changes the geometry or the joint values of a robot."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import RecipeError, nearest_choice
from pisigma.files.yaml_file import Section
from pisigma.robot.description import Robot

Value = TypeVar("Value")

JointErrorFunction = Callable[[Tensor], Tensor]
"""From commanded joint values `(*batch, dof)` to what is added to them [rad or m], of the same shape."""


@dataclass(frozen=True, eq=False)
class GeometryChange:
    """What is added to the geometric parameters of a robot; columns as `DH_COLUMNS` and `FRAME_COLUMNS`.

    Attributes:
        dh: `(rows, 5)` [rad or m].
        base: x, y, z [m], roll, pitch, yaw [rad].
        tool: the same for the tool.
    """

    dh: Float64[np.ndarray, "rows 5"]
    base: Float64[np.ndarray, " 6"]
    tool: Float64[np.ndarray, " 6"]


class AbstractErrorSource(Section, ABC):
    """An error source; concrete ones are an `AbstractGeometrySource`, `AbstractJointSource` or `AbstractPlaySource`.

    Attributes:
        kind: what recipes call it, a `Literal` of one text.
    """

    kind: str


class AbstractGeometrySource(AbstractErrorSource):
    """An error source that changes geometric parameters; the changes of several sources are added."""

    @abstractmethod
    def change(self, robot: Robot, place: str) -> GeometryChange:
        """What this source adds to the parameters of the nominal robot.

        Args:
            robot: the nominal robot.
            place: where the source stands in its recipe, for complaints.

        Raises:
            RecipeError: the source does not fit the robot.
        """


class AbstractJointSource(AbstractErrorSource):
    """An error source that moves joints away from where they are commanded; several sources are added."""

    @property
    def stepped_joints(self) -> frozenset[str]:
        """Names of the joints that move in steps by this source and so cannot end up just anywhere."""
        return frozenset()

    @abstractmethod
    def bind(self, robot: Robot, place: str) -> JointErrorFunction:
        """The source as a function of the commanded joint values of one robot.

        Args:
            robot: the nominal robot.
            place: where the source stands in its recipe, for complaints.

        Raises:
            RecipeError: the source does not fit the robot.
        """


class AbstractPlaySource(AbstractErrorSource):
    """An error source by which a joint stops on the side that it comes from; several sources are added.

    Attributes:
        seed: of the sides from which simulated rows are approached.
    """

    seed: int

    @abstractmethod
    def half_play(self, robot: Robot, place: str) -> Float64[np.ndarray, " dof"]:
        """How far every joint stops short of the commanded value [rad or m].

        Args:
            robot: the nominal robot.
            place: where the source stands in its recipe, for complaints.

        Raises:
            RecipeError: the source does not fit the robot.
        """


def row_index(robot: Robot, name: str, place: str) -> int:
    """Index of the row called `name`.

    Args:
        robot: the robot.
        name: what the recipe says.
        place: where in the recipe, for the complaint.

    Raises:
        RecipeError: the robot has no such row; the message gives the nearest name.
    """
    return _index(robot, [row.name for row in robot.rows], name, "row", place)


def joint_index(robot: Robot, name: str, place: str) -> int:
    """Index of the joint called `name`, counted among the rows that move. See `row_index`."""
    return _index(robot, [joint.name for joint in robot.joints], name, "joint", place)


def _index(robot: Robot, names: list[str], name: str, what: str, place: str) -> int:
    if name not in names:
        raise RecipeError(
            f"{place}: robot '{robot.name}' has no {what} '{name}'; {nearest_choice(name, names)}"
        )
    return names.index(name)


def stated_joints(
    robot: Robot,
    for_revolute: Mapping[str, Value],
    for_prismatic: Mapping[str, Value],
    fields: tuple[str, str],
    place: str,
    axes: bool = False,
) -> dict[int, Value]:
    """What the two mappings of a recipe state, by index of the joint.

    Args:
        robot: the robot.
        for_revolute: values of revolute joints, by name.
        for_prismatic: values of prismatic joints, by name.
        fields: how the recipe calls the two mappings, revolute first.
        place: where in the recipe, for complaints.
        axes: whether the values are of what the controller commands, `robot.axes`, and not of the joints.

    Raises:
        RecipeError: an unknown joint, or one in the mapping of the other type.
    """
    values: dict[int, Value] = {}
    joints = robot.axes if axes else robot.joints
    kinds = ((for_revolute, *fields, "revolute"), (for_prismatic, *fields[::-1], "prismatic"))
    for mapping, field, other, kind in kinds:
        for name, value in mapping.items():
            index = _index(robot, [joint.name for joint in joints], name, "joint", place)
            actual = joints[index].type
            if actual != kind:
                raise RecipeError(
                    f"{place}: joint '{name}' is {actual}, so state it in {other}, not in {field}."
                )
            values[index] = value
    return values


def joint_values(
    robot: Robot,
    for_revolute: Mapping[str, float],
    for_prismatic: Mapping[str, float],
    fields: tuple[str, str],
    place: str,
) -> Float64[np.ndarray, " dof"]:
    """One value per joint, 0 where none is stated. See `stated_joints`."""
    stated = stated_joints(robot, for_revolute, for_prismatic, fields, place)
    return np.array([stated.get(index, 0.0) for index in range(robot.dof)])


def amplitude_of(
    robot: Robot, joint: str, deg: float | None, mm: float | None, place: str
) -> Float64[np.ndarray, " dof"]:
    """The amplitude of a wave [rad or m] in the column of its joint, 0 elsewhere. See `stated_joints`.

    Args:
        robot: the robot.
        joint: that errs.
        deg: amplitude of a joint that turns.
        mm: amplitude of a joint that slides.
        place: where in the recipe, for complaints.
    """
    stated = joint_values(
        robot,
        {} if deg is None else {joint: deg},
        {} if mm is None else {joint: mm},
        ("amplitude_deg", "amplitude_mm"),
        place,
    )
    return np.where(robot.revolute, np.deg2rad(stated), stated / 1e3)
