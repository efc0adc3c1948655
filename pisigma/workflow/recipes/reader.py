"""Read a recipe of any kind, and check it against its robot."""

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import ConfigDict

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.files.errors import IdentificationError, RecipeError, RobotError, choice_remedy
from pisigma.files.yaml_file import Section, place_of_key, read_yaml
from pisigma.network.inputs import Inputs
from pisigma.network.sections import GradientDescentSection
from pisigma.robot.description import Robot
from pisigma.simulation.camera.simulated_images import SimulatedImages
from pisigma.simulation.measure import SimulatedPoses
from pisigma.simulation.poses import JointsRandom
from pisigma.simulation.true_robot import TrueRobot
from pisigma.workflow.recipes.recipe import (
    GeometricRecipe,
    HybridRecipe,
    InverseRecipe,
    Recipe,
    SimulatedData,
)

Key = tuple[str | int, ...]
Check = tuple[Key, Callable[[], object]]
"""Keys that lead to a value of a recipe, and the function that checks the value."""


class _KindOnly(Section):
    model_config = ConfigDict(extra="ignore")
    kind: Literal["inverse_calibration", "geometric_calibration", "hybrid_calibration"] = (
        "inverse_calibration"
    )


def read_recipe(path: str | os.PathLike[str]) -> Recipe:
    """Read a recipe of any kind, and check it against its robot.

    Raises:
        RecipeError: the file cannot be read, or a value is invalid; the message names file, line and key.
        RobotError: the robot of the recipe cannot be used; the message also names file, line and key.
    """
    kinds: dict[str, tuple[type[Recipe], Callable[[Any, Robot], Iterator[Check]]]] = {
        "inverse_calibration": (InverseRecipe, _network_checks),
        "geometric_calibration": (GeometricRecipe, _geometric_checks),
        "hybrid_calibration": (HybridRecipe, _hybrid_checks),
    }
    kind, checks = kinds[read_yaml(path, _KindOnly, RecipeError).kind]
    recipe = read_yaml(path, kind, RecipeError)
    try:
        robot = Robot.load(recipe.robot)
    except RobotError as problem:
        raise problem.with_place(place_of_key(path, ("robot",))) from None
    for keys, check in checks(recipe, robot):
        try:
            check()
        except (RecipeError, IdentificationError) as problem:
            raise problem.with_place(place_of_key(path, keys), RecipeError) from None
    return recipe


def recipe_hash(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hexadecimal) of the recipe file, for provenance."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _hybrid_checks(recipe: HybridRecipe, robot: Robot) -> Iterator[Check]:
    yield ("hybrid",), partial(recipe.calibrator, robot)
    yield from _simulation_checks(recipe, robot)


def _simulation_checks(recipe: InverseRecipe | HybridRecipe, robot: Robot) -> Iterator[Check]:
    if isinstance(recipe.data, SimulatedData):
        yield ("data", "errors"), partial(TrueRobot, robot, recipe.data.errors)
        yield from _where_checks(("data", "training"), recipe.data.training, robot)
        yield from _where_checks(("data", "held_out"), recipe.data.held_out, robot)


def _geometric_checks(recipe: GeometricRecipe, robot: Robot) -> Iterator[Check]:
    yield ("errors",), partial(TrueRobot, robot, recipe.errors)
    yield from _where_checks(("measurements",), recipe.measurements, robot)
    yield from _where_checks(("held_out",), recipe.held_out, robot)
    yield ("held_out", "frame"), partial(_check_frames, recipe.measurements.frame, recipe.held_out.frame)
    calibrator = recipe.calibration.calibrator(robot)
    space = ParameterSpace(robot, (recipe.measurements.frame,), (recipe.measurements.target,))
    yield ("calibration", "free"), partial(calibrator.candidates, space)


def _check_frames(calibrated: str, compared: str) -> None:
    if compared != calibrated:
        raise RecipeError(
            expected=f"the calibrated frame '{calibrated}'",
            value=compared,
            remedy="name the same frame in measurements and held_out",
        )


def _network_checks(recipe: InverseRecipe, robot: Robot) -> Iterator[Check]:
    joints = [joint.name for joint in robot.joints]
    corrected: list[str] = []
    for index, group in enumerate(recipe.network):
        yield ("network", index, "joints"), partial(_check_joints, group.joints, joints, tuple(corrected))
        reference = np.array(group.reference, dtype=np.float64)
        yield ("network", index, "inputs"), partial(Inputs.from_names, robot, group.inputs, reference)
        corrected.extend(group.joints)
    for name in recipe.paper:
        yield ("paper", name), partial(_check_joints, (name,), joints, ())
    if isinstance(recipe.fit, GradientDescentSection):
        for name in recipe.fit.learning_rate:
            yield ("fit", "learning_rate", name), partial(_check_joints, (name,), corrected, ())
        yield ("fit", "learning_rate"), partial(recipe.fit.rates, corrected)
    yield from _simulation_checks(recipe, robot)


def _where_checks(keys: Key, section: SimulatedPoses, robot: Robot) -> Iterator[Check]:
    """Yield the checks of a section of simulated poses."""
    if isinstance(section, SimulatedImages):
        yield (*keys, "poses"), partial(section.poses.closed_form, robot)
    elif isinstance(section.poses, JointsRandom):
        yield (*keys, "poses"), partial(section.poses.joints, robot)
    elif section.branch is not None:
        none = torch.zeros(0, 4, 4, dtype=torch.float64)  # without poses, only the names are checked
        yield (*keys, "branch"), partial(section.branch.start_joints, robot, none)


def _check_joints(names: Sequence[str], valid: Sequence[str], taken: Sequence[str]) -> None:
    for index, name in enumerate(names):
        if name not in valid:
            raise RecipeError(
                f"there is no joint '{name}' to correct", value=name, remedy=choice_remedy(name, valid)
            )
        if name in taken or name in names[:index]:
            raise RecipeError(
                f"joint '{name}' appears twice in the network", value=name, remedy="name each joint once"
            )
