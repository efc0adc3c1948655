"""Recipes: what to train, on what, and which published figures to hold it against."""

import hashlib
import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveInt

from pisigma.errors import RecipeError, nearest_choice
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import ErrorSource
from pisigma.training.fit_sections import FitSection
from pisigma.yaml_file import Section, read_yaml

Rotation = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class SimulatedData(Section):
    """Measurements of a simulated true robot.

    Attributes:
        kind: "simulated".
        errors: what is wrong with the true robot, completely.
        training: what is measured for training.
        held_out: what the fit is judged on and never sees.
    """

    kind: Literal["simulated"]
    errors: tuple[Annotated[ErrorSource, Field(discriminator="kind")], ...]
    training: SimulatedMeasurements
    held_out: SimulatedMeasurements


class MeasuredData(Section):
    """Measurements of a real robot, given with `--data`.

    Attributes:
        kind: "measured".
        folds: number of folds of the cross-validation; rows of equal joints stay together.
        seed: of the folds.
    """

    kind: Literal["measured"]
    folds: Annotated[int, Field(ge=2)] = 5
    seed: int = 0


class NetworkSection(Section):
    """One group of joints whose corrections see the same inputs. See `pisigma.network.inputs.Inputs`.

    Attributes:
        joints: names of the joints.
        inputs: names of the inputs.
        orders: summing units of every product unit; `[3]` is the paper's network, `[1, 2, 3]` a ridge polynomial.
        reference: rotation from which roll, pitch and yaw are counted, as three rows.
    """

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    orders: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
    reference: Rotation = ((1, 0, 0), (0, 1, 0), (0, 0, 1))


class SingularRows(Section):
    """What happens to training rows near a singularity, where joint differences explode.

    Attributes:
        rule: "keep", or "leave_out" where the measure is below the bound.
        below: smallest singular value of the joint Jacobian, translations over the characteristic length.
    """

    rule: Literal["keep", "leave_out"] = "leave_out"
    below: NonNegativeFloat = 0.02


class ErrorFigures(Section):
    """Average, standard deviation and maximum of the absolute joint error."""

    average_deg: NonNegativeFloat
    deviation_deg: NonNegativeFloat
    maximum_deg: NonNegativeFloat


class BeforeAfter(Section):
    """Published figures of one joint."""

    before: ErrorFigures
    after: ErrorFigures


class Recipe(Section):
    """A whole recipe.

    Attributes:
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        data: where measurements come from.
        network: the groups of joints to correct.
        fit: how the networks are trained.
        singular_rows: rule for rows near a singularity.
        paper: published figures by joint, to stand beside ours.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    network: Annotated[tuple[NetworkSection, ...], Field(min_length=1)]
    fit: Annotated[FitSection, Field(discriminator="method")]
    singular_rows: SingularRows = SingularRows()
    paper: dict[str, BeforeAfter] = {}


def read_recipe(path: str | os.PathLike[str]) -> Recipe:
    """Read a recipe and check it against its robot.

    Raises:
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
        RobotError: its robot cannot be used.
    """
    recipe = read_yaml(path, Recipe, RecipeError)
    joints = [joint.name for joint in Robot.load(recipe.robot).joints]
    for place, names in (
        ("network.joints", [name for group in recipe.network for name in group.joints]),
        ("paper", list(recipe.paper)),
        ("fit.learning_rate", list(getattr(recipe.fit, "learning_rate", {}))),
    ):
        for name in names:
            if name not in joints:
                raise RecipeError(f"{path}: '{place}' names joint '{name}'; {nearest_choice(name, joints)}")
        if len(set(names)) != len(names):
            raise RecipeError(f"{path}: '{place}' names a joint twice; name each once.")
    return recipe


def recipe_hash(path: str | os.PathLike[str]) -> str:
    """SHA-256 (hexadecimal) of the recipe file, for provenance."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
