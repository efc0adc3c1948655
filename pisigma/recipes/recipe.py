"""Recipes: what to train, on what, and which published figures to hold it against."""

import hashlib
import os
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, NonNegativeFloat

from pisigma.errors import RecipeError
from pisigma.recipes.recipe_checks import check_fit, inverse_checks
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import ErrorSource
from pisigma.training.fit_sections import FitSection, Seed
from pisigma.yaml_file import Section, read_yaml

_Row = tuple[float, float, float]


def _check_rotation(rows: tuple[_Row, _Row, _Row]) -> tuple[_Row, _Row, _Row]:
    R = np.array(rows, dtype=np.float64)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
        raise ValueError("the three rows are no rotation; give an orthonormal, right-handed matrix")
    return rows


Rotation = Annotated[tuple[_Row, _Row, _Row], AfterValidator(_check_rotation)]


class SimulatedData(Section):
    """Measurements of a simulated true robot.

    Attributes:
        kind: "simulated".
        errors: what is wrong with the true robot, completely.
        training: what is measured for training.
        held_out: what the fit is judged on and never sees.
    """

    kind: Literal["simulated"]
    errors: tuple[ErrorSource, ...]
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
    seed: Seed = 0


class NetworkSection(Section):
    """One group of joints whose corrections see the same inputs. See `pisigma.network.inputs.Inputs`.

    Attributes:
        joints: names of the joints.
        inputs: names of the inputs.
        orders: summing units of every product unit; `[3]` is the paper's network, `[1, 2, 3]` a ridge
            polynomial.
        reference: rotation from which roll, pitch and yaw are counted, as three rows.
    """

    joints: Annotated[tuple[str, ...], Field(min_length=1)]
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    orders: Annotated[tuple[Annotated[int, Field(ge=1, le=20)], ...], Field(min_length=1, max_length=20)]
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
    """A whole recipe of inverse calibration.

    Attributes:
        kind: "inverse_calibration"; recipes of the geometric calibrator are `GeometricRecipe`.
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

    kind: Literal["inverse_calibration"] = "inverse_calibration"
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    network: Annotated[tuple[NetworkSection, ...], Field(min_length=1)]
    fit: Annotated[FitSection, Field(discriminator="method")]
    singular_rows: SingularRows = SingularRows()
    paper: dict[str, BeforeAfter] = Field(default_factory=dict)


def read_recipe(path: str | os.PathLike[str]) -> Recipe:
    """Read a recipe and check it against its robot.

    Raises:
        RecipeError: the file cannot be read or does not fit; the message names file, line and key.
        RobotError: its robot cannot be used; the message names file, line and key too.
    """
    recipe = read_yaml(path, Recipe, RecipeError)
    check_fit(path, recipe.robot, partial(inverse_checks, recipe))
    return recipe


def recipe_hash(path: str | os.PathLike[str]) -> str:
    """SHA-256 (hexadecimal) of the recipe file, for provenance."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
