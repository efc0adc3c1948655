"""Recipes: what to train, on what, and which published figures to hold it against."""

import hashlib
import os
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat

from pisigma.errors import RecipeError
from pisigma.recipes.recipe_checks import check_fit, inverse_checks
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import ErrorSource
from pisigma.training.sections import FitSection, NetworkSection, Seed
from pisigma.yaml_file import Section, read_yaml


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
