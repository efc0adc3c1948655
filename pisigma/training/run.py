"""Running a recipe: data, training pairs, network, model."""

import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.correction.calibrated_model import CalibratedModel, Provenance
from pisigma.correction.domain import Domain
from pisigma.errors import RecipeError
from pisigma.identification.base_and_tool import fit_base_and_tool
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import groups_of_equal_joints
from pisigma.robot.description import Robot
from pisigma.simulation.true_robot import TrueRobot
from pisigma.training.fit_sections import LevenbergMarquardtSection
from pisigma.training.fitting import TrainingHistory, fit_networks
from pisigma.training.pairs import TrainingPairs, build_pairs
from pisigma.training.patterns import build_network, build_patterns
from pisigma.training.recipe import MeasuredData, Recipe, SimulatedData

MAXIMUM_STARTS = 512


@dataclass(frozen=True, eq=False)
class JointErrors:
    """Joint errors before and after the correction, of the same rows.

    Attributes:
        T: the poses.
        before: `Δ` [rad or m].
        after: `Δ` minus its prediction.
    """

    T: Float64[Tensor, "rows 4 4"]
    before: Float64[Tensor, "rows dof"]
    after: Float64[Tensor, "rows dof"]


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """What running a recipe gave.

    Attributes:
        model: the model, not yet written.
        history: the energies of the training.
        pairs: the training pairs.
        training: joint errors on the training rows.
        held_out: joint errors on simulated rows that the fit never saw; None for measured data.
        measurements: the training rows.
    """

    model: CalibratedModel
    history: TrainingHistory
    pairs: TrainingPairs
    training: JointErrors
    held_out: JointErrors | None
    measurements: Measurements


@dataclass(frozen=True)
class RunOptions:
    """How a training is run, apart from what it computes.

    Attributes:
        checkpoints: folder for checkpoints; None keeps none.
        resume: go on from the checkpoint there.
        show_progress: draw a bar on stderr.
        recipe_sha256: of the recipe file, for provenance.
    """

    checkpoints: Path | None = None
    resume: bool = False
    show_progress: bool = False
    recipe_sha256: str = ""


def load_measurements(recipe: Recipe, data: Path | None) -> Measurements:
    """Give the training rows of a recipe: simulated, or read from a file.

    Raises:
        RecipeError: a simulated recipe was given a file, or a measured one none.
        MeasurementError: the file cannot be used.
    """
    robot = Robot.load(recipe.robot)
    if isinstance(recipe.data, SimulatedData):
        if data is not None:
            raise RecipeError(f"recipe '{recipe.name}' simulates its data and takes no --data; leave it out.")
        return simulate_training(recipe)
    if data is None:
        raise RecipeError(f"recipe '{recipe.name}' is for measured data; give the file with --data FILE.csv.")
    return Measurements.read_csv(data, robot)


def simulate_training(recipe: Recipe) -> Measurements:
    """Measure the training rows of a recipe on its true robot.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    data = _simulated(recipe)
    return data.training.measure(TrueRobot(Robot.load(recipe.robot), data.errors))


def simulate_held_out(recipe: Recipe) -> Measurements:
    """Measure the held-out rows of a recipe on its true robot.

    Raises:
        RecipeError: the recipe is for measured data.
    """
    data = _simulated(recipe)
    return data.held_out.measure(TrueRobot(Robot.load(recipe.robot), data.errors))


def train_recipe(
    recipe: Recipe, measurements: Measurements, options: RunOptions = RunOptions()
) -> TrainingRun:
    """Train the model of a recipe.

    Args:
        recipe: the recipe.
        measurements: its rows, from `load_measurements`.
        options: checkpoints and progress.

    Raises:
        PisigmaError: the data or the recipe do not allow it; the message says what to do.
    """
    robot = Robot.load(recipe.robot)
    if isinstance(recipe.data, MeasuredData):
        robot = fit_base_and_tool(robot, measurements).robot
    bound = recipe.singular_rows.below if recipe.singular_rows.rule == "leave_out" else None
    pairs = build_pairs(robot, measurements, bound)
    held_out = _held_out_pairs(recipe, robot)
    network = build_network(robot, recipe.network, pairs)
    generator = torch.Generator().manual_seed(recipe.fit.seed)
    share = recipe.fit.validation_share if isinstance(recipe.fit, LevenbergMarquardtSection) else 0.0
    patterns = build_patterns(network, pairs, share, groups_of_equal_joints(measurements.q), generator)
    history = fit_networks(
        [net for _, net in network.members()],
        patterns,
        [section.joints for section in recipe.network],
        recipe.fit,
        title=recipe.name,
        checkpoints=options.checkpoints,
        fingerprint=f"{recipe.model_dump_json()}|{measurements.content_hash()}",
        resume=options.resume,
        show_progress=options.show_progress,
    )
    network.requires_grad_(False)
    used = pairs.used
    model = CalibratedModel(
        name=recipe.name,
        kind="inverse_calibration",
        robot=robot,
        network=network,
        domain=Domain.around(network.scaled_inputs(pairs.T[used], pairs.q_nominal[used]), generator),
        branches=pairs.branches,
        starts=_spread_rows(measurements.q[used]),
        provenance=_provenance(recipe, measurements, pairs, options),
    )
    unseen = joint_errors(model, held_out) if held_out else None
    return TrainingRun(model, history, pairs, joint_errors(model, pairs), unseen, measurements)


def joint_errors(model: CalibratedModel, pairs: TrainingPairs) -> JointErrors:
    """Joint errors of the used rows, before and after the model's correction."""
    T, q, before = pairs.T[pairs.used], pairs.q_nominal[pairs.used], pairs.target[pairs.used]
    return JointErrors(T, before, before - model.correction(T, q))


def _held_out_pairs(recipe: Recipe, robot: Robot) -> TrainingPairs | None:
    """Fresh simulated poses, all of which must have a joint error to judge by."""
    if not isinstance(recipe.data, SimulatedData):
        return None
    pairs = build_pairs(robot, simulate_held_out(recipe), None)
    if not pairs.used.all():
        raise RecipeError(
            f"recipe '{recipe.name}': {int((~pairs.used).sum())} of {len(pairs.used)} poses of data.held_out "
            "cannot be reached by the nominal robot and have no joint error; change their region."
        )
    return pairs


def _spread_rows(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "starts dof"]:
    """All rows, or as many as are kept, evenly spread over them."""
    return q[torch.linspace(0, len(q) - 1, min(len(q), MAXIMUM_STARTS)).round().long()].clone()


def _simulated(recipe: Recipe) -> SimulatedData:
    if not isinstance(recipe.data, SimulatedData):
        raise RecipeError(f"recipe '{recipe.name}' is for measured data and simulates nothing; use another.")
    return recipe.data


def _provenance(
    recipe: Recipe, measurements: Measurements, pairs: TrainingPairs, options: RunOptions
) -> Provenance:
    return Provenance(
        recipe=recipe.name,
        recipe_sha256=options.recipe_sha256,
        data_source="simulation"
        if isinstance(recipe.data, SimulatedData)
        else Path(measurements.source).name,
        data_sha256=measurements.content_hash(),
        rows=int(pairs.used.sum()),
        rows_left_out=int((~pairs.used).sum()),
        rule=pairs.left_out,
        seed=recipe.fit.seed,
        versions={name: version(name) for name in ("pisigma", "torch")}
        | {"python": platform.python_version()},
    )
