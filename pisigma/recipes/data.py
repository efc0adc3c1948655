"""The rows of a recipe: simulated, or read from a file."""

import os
from typing import TypeVar

import torch

from pisigma.errors import RecipeError
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.splits import TrainTest
from pisigma.recipes.recipe import GeometricRecipe, HybridRecipe, InverseRecipe, Recipe, SimulatedData
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import TrueRobot
from pisigma.yaml_file import Section

Seeded = TypeVar("Seeded", bound=Section)


def load_measurements(
    recipe: InverseRecipe | HybridRecipe, data: Measurements | str | os.PathLike[str] | None
) -> Measurements:
    """Give the rows of a recipe: the simulated training rows, or all measured rows, the set "test" among them.

    Args:
        recipe: the recipe.
        data: for measured data: these, or a CSV file of them.

    Raises:
        RecipeError: a simulated recipe got data, or a measured one none.
        MeasurementError: the file cannot be used.
    """
    robot = Robot.load(recipe.robot)
    if isinstance(recipe.data, SimulatedData):
        if data is not None:
            raise RecipeError(f"recipe '{recipe.name}' simulates its data and takes no --data; leave it out.")
        return simulate_training(recipe)
    if data is None:
        raise RecipeError(f"recipe '{recipe.name}' is for measured data; give the file with --data FILE.csv.")
    return data if isinstance(data, Measurements) else Measurements.read_csv(data, robot)


def simulate_training(recipe: Recipe) -> Measurements:
    """Measure the training rows of a recipe on its true robot.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    data = simulated_data(recipe)
    return data.training.measure(TrueRobot(Robot.load(recipe.robot), data.errors))


def simulate_held_out(recipe: Recipe) -> Measurements:
    """Measure the held-out rows of a recipe on its true robot.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    data = simulated_data(recipe)
    return data.held_out.measure(TrueRobot(Robot.load(recipe.robot), data.errors))


def simulate_repeats(recipe: HybridRecipe) -> tuple[Measurements, tuple[TrainTest, ...]]:
    """Measure training and held-out rows of every repeat of a simulation.

    Returns:
        All rows together, and per repeat which of them are its training and its held-out rows.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    robot, rows, splits, start = Robot.load(recipe.robot), [], [], 0
    for repeat in range(recipe.repeats):
        data = repeated(simulated_data(recipe), repeat)
        true = TrueRobot(robot, data.errors)
        train, test = data.training.measure(true), data.held_out.measure(true)
        middle, end = start + train.rows, start + train.rows + test.rows
        splits.append((torch.arange(start, middle), torch.arange(middle, end)))
        rows += [train, test]
        start = end
    return join(rows), tuple(splits)


def simulated_data(recipe: Recipe) -> SimulatedData:
    """What a recipe simulates; a geometric one states it beside its other settings.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    if isinstance(recipe, GeometricRecipe):
        errors, training, held_out = recipe.errors, recipe.measurements, recipe.held_out
        return SimulatedData(kind="simulated", errors=errors, training=training, held_out=held_out)
    if not isinstance(recipe.data, SimulatedData):
        raise RecipeError(f"recipe '{recipe.name}' is for measured data and simulates nothing; use another.")
    return recipe.data


def repeated(data: SimulatedData, repeat: int) -> SimulatedData:
    """A simulation with everything that is random drawn anew: all its seeds higher by the number of the repeat."""
    return data.model_copy(
        update={
            "errors": tuple(_reseeded(source, repeat) for source in data.errors),
            "training": _measured_anew(data.training, repeat),
            "held_out": _measured_anew(data.held_out, repeat),
        }
    )


def _measured_anew(section: SimulatedMeasurements, repeat: int) -> SimulatedMeasurements:
    noise = None if section.noise is None else _reseeded(section.noise, repeat)
    return section.model_copy(update={"poses": _reseeded(section.poses, repeat), "noise": noise})


def _reseeded(section: Seeded, repeat: int) -> Seeded:
    seed = getattr(section, "seed", None)
    return section if seed is None else section.model_copy(update={"seed": seed + repeat})
