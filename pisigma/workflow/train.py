"""Running a recipe: data, training pairs, network, model."""

import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import MeasurementError, RecipeError
from pisigma.identification.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import groups_of_equal_joints
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.stored_starts import spread_rows
from pisigma.recipes.recipe import MeasuredData, Recipe, SimulatedData
from pisigma.recipes.recipe_data import simulate_held_out
from pisigma.robot.description import Robot
from pisigma.training.networks import TrainingHistory, fit_networks
from pisigma.training.pairs import TrainingPairs, build_pairs
from pisigma.training.patterns import build_network, build_patterns
from pisigma.training.sections import LevenbergMarquardtSection
from pisigma.training.trainer import Checkpoints


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


def train_recipe(
    recipe: Recipe, measurements: Measurements, options: RunOptions = RunOptions()
) -> TrainingRun:
    """Train the model of a recipe.

    Args:
        recipe: the recipe.
        measurements: its rows, from `load_measurements`; rows of the set "test" are not trained on.
        options: checkpoints and progress.

    Raises:
        PisigmaError: the data or the recipe do not allow it; the message says what to do.
    """
    measurements, _ = measurements.split_sets()
    robot = Robot.load(recipe.robot)
    if isinstance(recipe.data, MeasuredData):
        check_one_pose(measurements)
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
        checkpoints=_checkpoints(recipe, measurements, options),
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
        starts=spread_rows(measurements.q[used]),
        provenance=_provenance(recipe, measurements, pairs, options),
    )
    other = joint_errors(model, held_out) if held_out else None
    return TrainingRun(model, history, pairs, joint_errors(model, pairs), other, measurements)


def _checkpoints(recipe: Recipe, measurements: Measurements, options: RunOptions) -> Checkpoints | None:
    if options.checkpoints is None:
        return None
    fingerprint = f"{recipe.model_dump_json()}|{measurements.content_hash()}"
    return Checkpoints(options.checkpoints, fingerprint, options.resume)


def check_one_pose(measurements: Measurements) -> None:
    """Refuse rows of several frames or targets: the poses of a correction are those of one tool in one frame.

    Raises:
        MeasurementError: there are several; the message names the first row of another.
    """
    for what, names in (("frame", measurements.frame), ("target", measurements.target)):
        other = next((row for row, name in enumerate(names) if name != names[0]), None)
        if other is not None:
            raise MeasurementError(
                f"{measurements.place(other)}: {what} '{names[other]}' stands there, but "
                f"{measurements.place(0)} has '{names[0]}'; inverse calibration wants the rows of one {what}, "
                "so give a file for each, or use `pisigma calibrate`."
            )


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
