"""Train and cross-validate the networks of a recipe of inverse calibration."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.engines.processes import in_processes
from pisigma.files.errors import MeasurementError, RecipeError
from pisigma.files.progress import Progress, silent
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.stored_starts import spread_rows
from pisigma.network.pairs import TrainingPairs, build_pairs
from pisigma.network.patterns import build_network, build_patterns
from pisigma.network.sections import LevenbergMarquardtSection
from pisigma.robot.description import Robot
from pisigma.validation.held_out.pose_statistics import Comparison, PoseErrors, compare_on
from pisigma.validation.held_out.training_summary import ComparisonFigures, JointErrors, TrainingRun
from pisigma.workflow.recipes.data import RecipeData
from pisigma.workflow.recipes.recipe import InverseRecipe, SimulatedData
from pisigma.workflow.settings.training import TrainSettings


def train_networks(
    recipe: InverseRecipe,
    data: RecipeData,
    settings: TrainSettings = TrainSettings(),
    recipe_sha256: str = "",
) -> TrainingRun:
    """Train the networks of a recipe, without judging them.

    Args:
        recipe: the recipe.
        data: its robot and rows.
        settings: checkpoints, progress and logs.
        recipe_sha256: of the recipe file, for provenance.

    Raises:
        PisigmaError: the data or the recipe do not allow it; the message says what to do.
    """
    from pisigma.network.networks import fit_networks  # imports lightning, which takes seconds
    from pisigma.network.trainer import Checkpoints

    robot, measurements = data.robot, data.training
    if data.folds is not None:
        _check_one_pose(measurements)
        robot = fit_base_and_tool(robot, measurements).robot
    bound = recipe.singular_rows.below if recipe.singular_rows.rule == "leave_out" else None
    pairs = build_pairs(robot, measurements, bound)
    held_out = None if data.held_out is None else _held_out_pairs(recipe.name, robot, data.held_out)
    network = build_network(robot, recipe.network, pairs)
    generator = torch.Generator().manual_seed(recipe.fit.seed)
    share = recipe.fit.validation_share if isinstance(recipe.fit, LevenbergMarquardtSection) else 0.0
    patterns = build_patterns(network, pairs, share, groups_of_equal_joints(measurements.q), generator)
    checkpoints = None
    if settings.checkpoints is not None:
        fingerprint = f"{recipe.model_dump_json()}|{measurements.content_hash()}"
        checkpoints = Checkpoints(settings.checkpoints, fingerprint, settings.resume)
    history = fit_networks(
        [net for _, net in network.members()],
        patterns,
        [section.joints for section in recipe.network],
        recipe.fit,
        checkpoints=checkpoints,
        show_progress=settings.show_progress,
        logs=settings.logs,
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
        provenance=_provenance(recipe, measurements, pairs, recipe_sha256),
    )
    other = JointErrors.of(model, held_out) if held_out else None
    return TrainingRun(model, history, pairs, JointErrors.of(model, pairs), other, measurements)


def cross_validate(
    recipe: InverseRecipe,
    data: RecipeData,
    progress: Progress = lambda what: None,
    jobs: int | None = None,
) -> ComparisonFigures:
    """Train the recipe once per fold, on the other folds, and judge it on the fold.

    Args:
        recipe: for measured data.
        data: its robot and rows; every row to train on is held out once.
        progress: called before every fold, but for those in other processes.
        jobs: see `TrainSettings`.

    Raises:
        RecipeError: the recipe simulates its data.
        MeasurementError: there are fewer different joint vectors than folds.
    """
    if data.folds is None:
        raise RecipeError(f"recipe '{recipe.name}' simulates its data; it has held-out rows of its own.")
    measurements, folds = data.splits()
    turned, not_predicted = measurements.rotation is not None, 0
    nominal, corrected = (PoseErrors.none(measurements.rows, turned) for _ in range(2))
    tasks = [
        partial(
            _compared_fold,
            recipe,
            replace(data, training=measurements.select(training)),
            measurements.select(test),
            partial(progress if jobs is None else silent, f"cross-validation: fold {number} of {len(folds)}"),
        )
        for number, (training, test) in enumerate(folds, start=1)
    ]
    comparisons = (task() for task in tasks) if jobs is None else in_processes(tasks, jobs)
    for (_, test), comparison in zip(folds, comparisons, strict=True):
        not_predicted += comparison.not_predicted
        nominal.put(test, comparison.nominal)
        corrected.put(test, comparison.corrected)
    return ComparisonFigures.of(Comparison(nominal, corrected, not_predicted), folds=len(folds))


def _compared_fold(
    recipe: InverseRecipe, data: RecipeData, test: Measurements, begin: Callable[[], None]
) -> Comparison:
    """Train on some rows, and compare on others."""
    begin()
    return compare_on(train_networks(recipe, data).model, test)


def _check_one_pose(measurements: Measurements) -> None:
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


def _held_out_pairs(name: str, robot: Robot, held_out: Measurements) -> TrainingPairs:
    """Fresh simulated poses, all of which must have a joint error to judge by."""
    pairs = build_pairs(robot, held_out, None)
    if not pairs.used.all():
        raise RecipeError(
            f"recipe '{name}': {int((~pairs.used).sum())} of {len(pairs.used)} poses of data.held_out "
            "cannot be reached by the nominal robot and have no joint error; change their region."
        )
    return pairs


def _provenance(
    recipe: InverseRecipe, measurements: Measurements, pairs: TrainingPairs, sha256: str
) -> Provenance:
    return Provenance(
        recipe=recipe.name,
        recipe_sha256=sha256,
        data_source="simulation"
        if isinstance(recipe.data, SimulatedData)
        else Path(measurements.source).name,
        data_sha256=measurements.content_hash(),
        rows=int(pairs.used.sum()),
        rows_left_out=int((~pairs.used).sum()),
        rule=pairs.left_out,
        seed=recipe.fit.seed,
        versions=Provenance.present_versions(),
    )
