"""What of a recipe only its robot can judge: names of joints, inputs and branches."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from pisigma.errors import RecipeError, nearest_choice
from pisigma.network.inputs import Inputs
from pisigma.robot.description import Robot
from pisigma.simulation.random_joints import JointsRandom
from pisigma.simulation.true_robot import TrueRobot
from pisigma.training.fit_sections import GradientDescentSection

if TYPE_CHECKING:
    from pisigma.training.recipe import Recipe

Place = tuple[str | int, ...]
Check = tuple[Place, Callable[[], object]]


def find_misfit(recipe: "Recipe", robot: Robot) -> tuple[Place, str] | None:
    """First thing in a recipe that does not fit its robot: the keys that lead to it, and what to do."""
    for place, check in (*_network_checks(recipe, robot), *_data_checks(recipe, robot)):
        try:
            check()
        except RecipeError as problem:
            return place, str(problem)
    return None


def _network_checks(recipe: "Recipe", robot: Robot) -> Iterator[Check]:
    joints = [joint.name for joint in robot.joints]
    corrected: list[str] = []
    for index, group in enumerate(recipe.network):
        yield ("network", index, "joints"), partial(_check_joints, group.joints, joints, tuple(corrected))
        reference = np.array(group.reference, dtype=np.float64)
        yield ("network", index, "inputs"), partial(Inputs.of, robot, group.inputs, reference)
        corrected.extend(group.joints)
    for name in recipe.paper:
        yield ("paper", name), partial(_check_joints, (name,), joints, ())
    if isinstance(recipe.fit, GradientDescentSection):
        for name in recipe.fit.learning_rate:
            yield ("fit", "learning_rate", name), partial(_check_joints, (name,), corrected, ())
        yield ("fit", "learning_rate"), partial(recipe.fit.rates, corrected)


def _data_checks(recipe: "Recipe", robot: Robot) -> Iterator[Check]:
    data = recipe.data
    if data.kind == "measured":
        return
    yield ("data", "errors"), partial(TrueRobot, robot, data.errors)
    none = torch.zeros(0, 4, 4, dtype=torch.float64)  # no poses: only the names are looked at
    for part, section in (("training", data.training), ("held_out", data.held_out)):
        if isinstance(section.poses, JointsRandom):
            yield ("data", part, "poses"), partial(section.poses.joints, robot)
        elif section.branch is not None:
            yield ("data", part, "branch"), partial(section.branch.start, robot, none)


def _check_joints(names: Sequence[str], valid: Sequence[str], taken: Sequence[str]) -> None:
    for index, name in enumerate(names):
        if name not in valid:
            raise RecipeError(f"there is no joint '{name}' to correct; {nearest_choice(name, valid)}")
        if name in taken or name in names[:index]:
            raise RecipeError(f"joint '{name}' stands twice in the network; name each joint once.")
