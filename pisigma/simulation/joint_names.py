"""Finding the joints and rows that an error source names, and reading its values per joint."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float64

from pisigma.errors import RecipeError, nearest_choice
from pisigma.robot.description import Robot


def row_index(robot: Robot, name: str, place: str) -> int:
    """Index of the row called `name`.

    Args:
        robot: the robot.
        name: what the recipe says.
        place: where in the recipe, for the complaint.

    Raises:
        RecipeError: the robot has no such row; the message gives the nearest name.
    """
    names = [row.name for row in robot.rows]
    if name not in names:
        raise RecipeError(f"{place}: robot '{robot.name}' has no row '{name}'; {nearest_choice(name, names)}")
    return names.index(name)


def joint_index(robot: Robot, name: str, place: str) -> int:
    """Index of the joint called `name`, counted among the rows that move. See `row_index`."""
    names = [joint.name for joint in robot.joints]
    if name not in names:
        raise RecipeError(
            f"{place}: robot '{robot.name}' has no joint '{name}'; {nearest_choice(name, names)}"
        )
    return names.index(name)


def joint_values(
    robot: Robot,
    for_revolute: Mapping[str, float],
    for_prismatic: Mapping[str, float],
    fields: tuple[str, str],
    place: str,
) -> Float64[np.ndarray, " dof"]:
    """One value per joint from the two mappings of a recipe; a joint that neither names has 0.

    Args:
        robot: the robot.
        for_revolute: values of revolute joints, by name.
        for_prismatic: values of prismatic joints, by name.
        fields: how the recipe calls the two mappings, revolute first.
        place: where in the recipe, for complaints.

    Raises:
        RecipeError: an unknown joint, or one in the mapping of the other type.
    """
    values = np.zeros(robot.dof)
    for mapping, field, other, kind in (
        (for_revolute, fields[0], fields[1], "revolute"),
        (for_prismatic, fields[1], fields[0], "prismatic"),
    ):
        for name, value in mapping.items():
            index = joint_index(robot, name, place)
            found = robot.joints[index].type
            if found != kind:
                raise RecipeError(
                    f"{place}: joint '{name}' is {found}, so state it in {other}, not in {field}."
                )
            values[index] = value
    return values
