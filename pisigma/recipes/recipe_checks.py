"""What of a recipe only its robot can judge: names of joints, inputs and branches."""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch

from pisigma.errors import IdentificationError, RecipeError, RobotError, nearest_choice
from pisigma.identification.problem.parameters import ParameterSpace
from pisigma.network.inputs import Inputs
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.poses import JointsRandom
from pisigma.simulation.true_robot import TrueRobot
from pisigma.training.sections import GradientDescentSection
from pisigma.yaml_file import line_of

if TYPE_CHECKING:
    from pisigma.recipes.geometric_recipe import GeometricRecipe
    from pisigma.recipes.recipe import Recipe

Place = tuple[str | int, ...]
Check = tuple[Place, Callable[[], object]]


def check_fit(
    path: str | os.PathLike[str], robot: str, checks_of: Callable[[Robot], Iterable[Check]]
) -> None:
    """Check what a recipe says against its robot.

    Args:
        path: the recipe's file.
        robot: name or file of its robot.
        checks_of: gives, for the robot, the keys that lead to a part of the recipe and what to try with it.

    Raises:
        RecipeError: something does not fit; the message names file, line and key.
        RobotError: the robot cannot be used; the message names file, line and key too.
    """
    try:
        loaded = Robot.load(robot)
    except RobotError as problem:
        raise type(problem)(f"{path}, line {line_of(path, ('robot',))}: 'robot': {problem}") from None
    for keys, check in checks_of(loaded):
        try:
            check()
        except (RecipeError, IdentificationError) as problem:
            place = ".".join(str(key) for key in keys)
            raise RecipeError(f"{path}, line {line_of(path, keys)}: '{place}': {problem}") from None


def inverse_checks(recipe: "Recipe", robot: Robot) -> Iterator[Check]:
    """What to try with a recipe of inverse calibration."""
    yield from _network_checks(recipe, robot)
    if recipe.data.kind == "simulated":
        yield ("data", "errors"), partial(TrueRobot, robot, recipe.data.errors)
        for part, section in (("training", recipe.data.training), ("held_out", recipe.data.held_out)):
            yield from where_checks(("data", part), section, robot)


def geometric_checks(recipe: "GeometricRecipe", robot: Robot) -> Iterator[Check]:
    """What to try with a recipe of the geometric calibrator."""
    yield ("errors",), partial(TrueRobot, robot, recipe.errors)
    yield from where_checks(("measurements",), recipe.measurements, robot)
    yield from where_checks(("held_out",), recipe.held_out, robot)
    yield ("held_out", "frame"), partial(_check_frames, recipe.measurements.frame, recipe.held_out.frame)
    calibrator = recipe.calibration.calibrator(robot)
    space = ParameterSpace(robot, (recipe.measurements.frame,), ("",))
    yield ("calibration", "free"), partial(calibrator.candidates, space)


def _check_frames(calibrated: str, judged: str) -> None:
    if judged != calibrated:
        raise RecipeError(
            f"the frame '{judged}' is not calibrated, the measurements are in '{calibrated}'; name the same frame."
        )


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


def where_checks(place: Place, section: SimulatedMeasurements, robot: Robot) -> Iterator[Check]:
    """What to try with a section that says where to measure.

    Args:
        place: the keys that lead to it.
        section: it.
        robot: the nominal robot.
    """
    if isinstance(section.poses, JointsRandom):
        yield (*place, "poses"), partial(section.poses.joints, robot)
    elif section.branch is not None:
        none = torch.zeros(0, 4, 4, dtype=torch.float64)  # no poses: only the names are looked at
        yield (*place, "branch"), partial(section.branch.start, robot, none)


def _check_joints(names: Sequence[str], valid: Sequence[str], taken: Sequence[str]) -> None:
    for index, name in enumerate(names):
        if name not in valid:
            raise RecipeError(f"there is no joint '{name}' to correct; {nearest_choice(name, valid)}")
        if name in taken or name in names[:index]:
            raise RecipeError(f"joint '{name}' stands twice in the network; name each joint once.")
