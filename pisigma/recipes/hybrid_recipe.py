"""Recipes of the hybrid calibrator, on measured data or on simulated robots."""

from collections.abc import Iterator
from functools import partial
from typing import Annotated, Literal, TypeVar

from pydantic import Field, PositiveInt

from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.hybrid.mini_batches import MiniBatches
from pisigma.recipes.geometric_recipe import CalibrationSection
from pisigma.recipes.recipe import MeasuredData, SimulatedData
from pisigma.recipes.recipe_checks import Check, where_checks
from pisigma.robot.description import Robot
from pisigma.simulation.measure import SimulatedMeasurements
from pisigma.simulation.true_robot import TrueRobot
from pisigma.training.sections import Seed
from pisigma.yaml_file import Section

Part = TypeVar("Part", bound=Section)


class HybridSection(Section):
    """What `HybridCalibrator` may choose from; whatever does not help is left out.

    Attributes:
        features: of the unit of order 1 that are tried.
        harmonics: of the Fourier series, tried in this order.
        orders: numbers of factors of product units, tried in this order.
        gravity: direction in which things fall, in the frame of the robot's first row.
        mini_batches: whether the unknowns are trained on mini-batches: true, false, or "auto" for many rows only; or
            their `batch_rows`, `epochs`, `learning_rate` and `seed`.
    """

    features: tuple[str, ...] = HybridCalibrator.features
    harmonics: tuple[int, ...] = HybridCalibrator.harmonics
    orders: tuple[tuple[int, ...], ...] = HybridCalibrator.orders
    gravity: tuple[float, float, float] = HybridCalibrator.gravity
    mini_batches: MiniBatches | bool | Literal["auto"] = HybridCalibrator.mini_batches


class LearningCurveSection(Section):
    """Which numbers of training rows are tried.

    Attributes:
        rows: the numbers; all training rows come on top.
        seed: decides which rows are drawn.
    """

    rows: Annotated[tuple[PositiveInt, ...], Field(min_length=1)]
    seed: Seed = 0


class HybridRecipe(Section):
    """A hybrid calibration, judged beside the nominal robot and the geometric calibration.

    Attributes:
        kind: "hybrid_calibration".
        name: of the recipe and, by default, of the model.
        description: what it shows, for the model's card.
        not_validated: what a reader must not take from it, for the card.
        robot: catalogue name or robot file of the nominal robot.
        data: where measurements come from; measured ones are judged in folds, simulated ones on held-out rows.
        repeats: of a simulation, with all its seeds one higher each time; the model is of the first.
        calibration: settings of the geometric calibrator.
        hybrid: settings of the hybrid calibrator.
        learning_curve: numbers of training rows to try; None for none.
    """

    kind: Literal["hybrid_calibration"]
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
    description: str
    not_validated: str
    robot: str
    data: Annotated[SimulatedData | MeasuredData, Field(discriminator="kind")]
    repeats: PositiveInt = 1
    calibration: CalibrationSection = CalibrationSection()
    hybrid: HybridSection = HybridSection()
    learning_curve: LearningCurveSection | None = None

    def calibrator(self) -> HybridCalibrator:
        """The calibrator for the nominal robot.

        Raises:
            IdentificationError: a choice of the section `hybrid` does not exist.
        """
        return _calibrator(self, Robot.load(self.robot))


def _calibrator(recipe: HybridRecipe, robot: Robot) -> HybridCalibrator:
    return HybridCalibrator(recipe.calibration.calibrator(robot), **dict(recipe.hybrid))


def hybrid_checks(recipe: HybridRecipe, robot: Robot) -> Iterator[Check]:
    """What to try with a recipe of the hybrid calibrator."""
    yield ("hybrid",), partial(_calibrator, recipe, robot)
    if isinstance(recipe.data, SimulatedData):
        yield ("data", "errors"), partial(TrueRobot, robot, recipe.data.errors)
        for part, section in (("training", recipe.data.training), ("held_out", recipe.data.held_out)):
            yield from where_checks(("data", part), section, robot)


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


def _reseeded(section: Part, repeat: int) -> Part:
    seed = getattr(section, "seed", None)
    return section if seed is None else section.model_copy(update={"seed": seed + repeat})
