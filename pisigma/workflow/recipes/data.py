"""The robot of a recipe and its rows: simulated, or read from a file."""

import os
import zlib
from dataclasses import dataclass
from typing import TypeVar

import torch

from pisigma.files.errors import RecipeError
from pisigma.files.yaml_file import Section
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.csv.reading import read_joints
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.splits import TrainTest, k_folds
from pisigma.robot.description import Robot
from pisigma.simulation.camera.simulated_images import SimulatedImages, write_images
from pisigma.simulation.measure import SimulatedPoses, SimulatedTracker
from pisigma.simulation.measure import simulate as measure
from pisigma.simulation.true_robot import TrueRobot
from pisigma.workflow.recipes.recipe import GeometricRecipe, HybridRecipe, MeasuredData, Recipe, SimulatedData

Seeded = TypeVar("Seeded", bound=Section)


@dataclass(frozen=True, eq=False)
class RecipeData:
    """Data on which a recipe is trained and validated.

    Attributes:
        robot: the nominal robot.
        training: rows for training.
        test: rows of the set "test" of measured data; None if there are none.
        simulations: training and held-out rows of every repeat of a simulation, beginning with rows of the model;
            empty for measured data.
        fold_settings: how measured rows are split for a cross-validation; None for simulated data.
    """

    robot: Robot
    training: Measurements
    test: Measurements | None = None
    simulations: tuple[tuple[Measurements, Measurements], ...] = ()
    fold_settings: MeasuredData | None = None

    @property
    def held_out(self) -> Measurements | None:
        """Held-out rows of the simulation; None for measured data."""
        return self.simulations[0][1] if self.simulations else None

    def splits(self) -> tuple[Measurements, tuple[TrainTest, ...]]:
        """Return all rows, and the training and held-out rows among them of every fold or simulation.

        Raises:
            MeasurementError: there are fewer different joint vectors than folds.
        """
        if self.fold_settings is not None:
            return self.training, k_folds(self.training, self.fold_settings.folds, self.fold_settings.seed)
        every = [rows for pair in self.simulations for rows in pair]
        joined = join(every)
        numbers = iter(torch.split(torch.arange(joined.rows), [rows.rows for rows in every]))
        return joined, tuple(zip(numbers, numbers, strict=True))


def load_data(recipe: Recipe, data: Measurements | str | os.PathLike[str] | None = None) -> RecipeData:
    """Simulate the rows of a recipe, or read measured rows.

    Args:
        recipe: the recipe.
        data: measurements or their CSV file, for a recipe that uses measured data.

    Raises:
        RecipeError: `data` is given for a recipe that simulates its data, or missing for one that does not.
        RobotError: the robot of the recipe cannot be used.
        MeasurementError: the file cannot be used.
    """
    if isinstance(recipe, GeometricRecipe) or isinstance(recipe.data, SimulatedData):
        if data is not None:
            raise RecipeError(
                f"recipe '{recipe.name}' simulates its data",
                value=recipe.name,
                option="--data",
                remedy="omit it",
            )
        return simulate(recipe, recipe.repeats if isinstance(recipe, HybridRecipe) else 1)
    if data is None:
        raise RecipeError(
            f"recipe '{recipe.name}' needs measured data",
            value=recipe.name,
            remedy="give the file with --data FILE.csv",
        )
    robot = Robot.load(recipe.robot)
    return RecipeData(robot, *read_rows(data, robot).split_sets(), fold_settings=recipe.data)


def simulate(recipe: Recipe, simulation_count: int = 1) -> RecipeData:
    """Simulate training and held-out rows of a recipe on its true robot.

    Args:
        recipe: a recipe for simulated data.
        simulation_count: number of simulations, each with different seeds.

    Raises:
        RecipeError: the recipe is for measured data.
        RobotError: the robot of the recipe cannot be used.
    """
    robot, stated, simulations = Robot.load(recipe.robot), simulated_data(recipe), []
    for repeat in range(simulation_count):
        data = with_other_seeds(stated, repeat)
        true = TrueRobot(robot, data.errors)
        simulations.append((data.training.measure(true), data.held_out.measure(true)))
    return RecipeData(robot, simulations[0][0], simulations=tuple(simulations))


def simulate_at(recipe: Recipe, joint_file: str | os.PathLike[str]) -> tuple[Robot, Measurements]:
    """Return simulated rows of a recipe's tracker at other joint values; equal calls return equal rows.

    Args:
        recipe: a recipe with a simulated tracker.
        joint_file: CSV file with columns of joint values, such as a plan.

    Returns:
        The nominal robot, and the rows.

    Raises:
        RecipeError: the recipe simulates no tracker.
        MeasurementError: the joint values cannot be read.
    """
    data, robot = simulated_data(recipe), Robot.load(recipe.robot)
    tracker = data.training
    if not isinstance(tracker, SimulatedTracker):
        raise RecipeError(
            expected="a recipe that simulates a tracker", value=recipe.name, option="--at", remedy="omit --at"
        )
    q, noise = read_joints(joint_file, robot), tracker.noise
    if noise is not None:  # other poses have different noise
        noise = noise.model_copy(update={"seed": noise.seed + zlib.crc32(q.numpy().tobytes())})
    return robot, measure(TrueRobot(robot, data.errors), q, tracker.sensor, noise)


def write_recipe_images(recipe: Recipe, folder: str | os.PathLike[str]) -> int:
    """Render the images with which a recipe calibrates; see `write_images`.

    Raises:
        RecipeError: the recipe simulates no images.
        RobotError: the robot of the recipe cannot be used.
        OutputError: the folder already exists, or cannot be written.
    """
    data = simulated_data(recipe)
    if not isinstance(data.training, SimulatedImages):
        raise RecipeError(
            f"recipe '{recipe.name}' simulates a tracker instead of images",
            value=recipe.name,
            remedy="write its measurements with --out",
        )
    return write_images(data.training, TrueRobot(Robot.load(recipe.robot), data.errors), folder)


def simulated_data(recipe: Recipe) -> SimulatedData:
    """Return the simulated data of a recipe, which a geometric recipe states at top level.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    if isinstance(recipe, GeometricRecipe):
        errors, training, held_out = recipe.errors, recipe.measurements, recipe.held_out
        return SimulatedData(kind="simulated", errors=errors, training=training, held_out=held_out)
    if not isinstance(recipe.data, SimulatedData):
        raise RecipeError(
            f"expected a recipe that simulates its data, got '{recipe.name}', which needs measured data",
            expected="a recipe that simulates its data",
            value=recipe.name,
        )
    return recipe.data


def with_other_seeds(data: SimulatedData, repeat: int) -> SimulatedData:
    """Return a simulation with other random numbers, by adding the number of the repeat to all of its seeds."""
    return data.model_copy(
        update={
            "errors": tuple(_reseeded(source, repeat) for source in data.errors),
            "training": _remeasured(data.training, repeat),
            "held_out": _remeasured(data.held_out, repeat),
        }
    )


def _remeasured(section: SimulatedPoses, repeat: int) -> SimulatedPoses:
    noise = None if section.noise is None else _reseeded(section.noise, repeat)
    return section.model_copy(update={"poses": _reseeded(section.poses, repeat), "noise": noise})


def _reseeded(section: Seeded, repeat: int) -> Seeded:
    seed = getattr(section, "seed", None)
    return section if seed is None else section.model_copy(update={"seed": seed + repeat})
