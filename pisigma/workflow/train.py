"""Train the model of a recipe."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.files.engines.processes import run_in_processes
from pisigma.files.errors import MeasurementError, RecipeError
from pisigma.files.progress import Progress, no_progress, with_stage
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.stored_starts import evenly_spaced_rows
from pisigma.network.pairs import TrainingPairs, build_pairs
from pisigma.network.patterns import build_network, build_patterns
from pisigma.network.sections import LevenbergMarquardtSection
from pisigma.reporting.cards import CardTexts, write_training_card
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_summary import summarise
from pisigma.validation.held_out.calibration_validation import judge, learning_curve, pose_errors_of, validate
from pisigma.validation.held_out.pose_statistics import Comparison, PoseErrors, compare_with_nominal
from pisigma.validation.held_out.training_summary import (
    ComparisonFigures,
    JointErrors,
    TrainingRun,
    TrainingSummary,
    summarise_training,
)
from pisigma.validation.held_out.validation_figures import ValidationFigures
from pisigma.workflow.calibrate import Calibration, compose_calibration
from pisigma.workflow.recipes.data import RecipeData, load_data
from pisigma.workflow.recipes.reader import read_recipe, recipe_hash
from pisigma.workflow.recipes.recipe import (
    GeometricRecipe,
    HybridRecipe,
    InverseRecipe,
    Recipe,
    SimulatedData,
)
from pisigma.workflow.result import AbstractModelResult
from pisigma.workflow.settings.training import TrainSettings


@dataclass(frozen=True, eq=False)
class InverseTraining(AbstractModelResult):
    """Result of `train` for an inverse calibration: networks on nominal joint values, and their validation.

    Attributes:
        model: the trained model, with all figures as its metrics, as `pisigma.load` would read it.
        recipe: the recipe.
        run: history, training pairs and joint errors of the training.
        summary: all figures.
        seconds: computing time [s].
    """

    model: CalibratedModel
    recipe: InverseRecipe
    run: TrainingRun
    summary: TrainingSummary
    seconds: float = 0.0

    @property
    def validation(self) -> ComparisonFigures | None:
        """Errors of held-out rows in the cross-validation of measured data; None for simulated data."""
        return self.summary.cross_validation

    @property
    def test(self) -> ComparisonFigures | None:
        """Errors of the rows of the set "test"; None if there are none."""
        return self.summary.test

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings, one sentence each."""
        rows = self.summary.rows
        return (f"{rows.left_out} rows were left out of the training: {rows.rule}.",) if rows.rule else ()

    def _describe(self, model: CalibratedModel, summary: TrainingSummary, folder: Path) -> None:
        texts = CardTexts(self.recipe.description, self.recipe.not_validated)
        write_training_card(model.name, texts, self.run, summary, folder)


Training = InverseTraining | Calibration


def train(
    recipe: Recipe | str | os.PathLike[str],
    data: Measurements | str | os.PathLike[str] | None = None,
    settings: TrainSettings = TrainSettings(),
    progress: Progress = lambda what: None,
) -> Training:
    """Train the model of a recipe, and validate it on held-out rows.

    Args:
        recipe: a recipe of any kind, or its file.
        data: measurements or their CSV file, for a recipe that uses measured data.
        settings: see `TrainSettings`.
        progress: called with the current step.

    Returns:
        `InverseTraining` for a recipe of inverse calibration, otherwise `Calibration`.

    Raises:
        RecipeError: the recipe cannot be read, or does not use `data` or `settings`.
        RobotError: the robot of the recipe cannot be used.
        MeasurementError: the data cannot be used.
        IdentificationError: the data do not determine the free parameters.
        TrainingError: the training diverged, or there is no checkpoint of this recipe and data to resume.
        OutputError: checkpoints cannot be written.
    """
    started = time.perf_counter()
    sha256 = ""
    if isinstance(recipe, str | os.PathLike):
        path = recipe
        recipe, sha256 = read_recipe(path), recipe_hash(path)
    loaded = load_data(recipe, data)
    result: Training
    if isinstance(recipe, GeometricRecipe):
        result = _train_geometric(recipe, sha256, loaded, settings)
    elif isinstance(recipe, HybridRecipe):
        result = _train_hybrid(recipe, sha256, loaded, settings, progress)
    else:
        result = _train_inverse(recipe, sha256, loaded, settings, progress)
    return replace(result, seconds=time.perf_counter() - started)


def _call(recipe: Recipe) -> str:
    """Return the call that repeats the training, for the card."""
    return f"pisigma.train({recipe.name!r})"


def _refuse_resume(recipe: Recipe) -> None:
    raise RecipeError(
        f"a recipe of kind {recipe.kind} ('{recipe.name}') cannot be resumed",
        value=recipe.kind,
        option="--resume",
        remedy="omit it",
    )


def _train_geometric(
    recipe: GeometricRecipe, sha256: str, data: RecipeData, settings: TrainSettings
) -> Calibration:
    if settings.resume:
        _refuse_resume(recipe)
    rows, held_out = data.simulations[0]
    calibrator = recipe.calibration.calibrator(data.robot)
    result = calibrator.fit(rows)
    errors = pose_errors_of(result, held_out).figures
    summary = summarise(result).with_figures(
        command=_call(recipe),
        redundant_sets=tuple(tuple(members) for members in result.pairwise_redundancy.sets),
        no_effect=tuple(result.pairwise_redundancy.no_effect),
        pairwise_parameters=len(result.pairwise_redundancy.kept),
        held_out=ValidationFigures(rows=held_out.rows, geometric=errors),
        paper=recipe.model_dump(mode="json")["paper"] or None,
    )
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose_calibration(
        calibrator, result, rows, summary, texts, recipe_name_and_hash=(recipe.name, sha256)
    )


def _train_hybrid(
    recipe: HybridRecipe,
    sha256: str,
    data: RecipeData,
    settings: TrainSettings,
    progress: Progress,
) -> Calibration:
    if settings.resume:
        _refuse_resume(recipe)
    rows = data.training
    measured = data.fold_settings is not None
    judged, splits = data.splits()
    calibrator = recipe.calibrator(data.robot)
    started = time.perf_counter()
    result = calibrator.fit(rows, with_stage(progress, "calibration"))
    seconds = time.perf_counter() - started
    validation = validate(calibrator, judged, splits, with_stage(progress, "held-out rows"), settings.jobs)
    test = None if data.test is None else judge(calibrator, result, rows, data.test)
    curve = None
    if (stated := recipe.learning_curve) is not None:
        of_curve = with_stage(progress, "learning curve")
        sizes, seed, jobs = stated.rows, stated.seed, settings.jobs
        curve = learning_curve(calibrator, judged, splits, sizes, seed, of_curve, validation, jobs)
    summary = summarise(result).with_figures(
        command=_call(recipe),
        rows=rows.rows,
        fit_seconds=round(seconds, 3),
        cross_validation=validation.figures() if measured else None,
        test=None if test is None else test.figures(),
        held_out=None if measured else validation.figures(splits),
        learning_curve=curve,
    )
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose_calibration(
        calibrator,
        result,
        rows,
        summary,
        texts,
        validation,
        test,
        held_out=rows if measured else None,
        recipe_name_and_hash=(recipe.name, sha256),
    )


def _train_inverse(
    recipe: InverseRecipe,
    sha256: str,
    data: RecipeData,
    settings: TrainSettings,
    progress: Progress,
) -> InverseTraining:
    run = train_networks(recipe, data, settings, sha256)
    validation = None if data.fold_settings is None else cross_validate(recipe, data, progress, settings.jobs)
    test = None
    if data.test is not None:
        test = ComparisonFigures.from_comparison(
            compare_with_nominal(run.model, data.test), rows=data.test.rows
        )
    summary = summarise_training(run, recipe.paper, validation, test).with_figures(command=_call(recipe))
    model = replace(run.model, metrics=summary.to_json())
    return InverseTraining(model, recipe, run, summary)


def train_networks(
    recipe: InverseRecipe,
    data: RecipeData,
    settings: TrainSettings = TrainSettings(),
    recipe_sha256: str = "",
) -> TrainingRun:
    """Train the networks of a recipe, without validating them.

    Args:
        recipe: the recipe.
        data: its robot and rows.
        settings: checkpoints, progress and logs.
        recipe_sha256: SHA-256 of the recipe file, for provenance.

    Raises:
        PisigmaError: the data or the recipe cannot be used; the message states a remedy.
    """
    from pisigma.network.networks import fit_networks  # imports lightning, which takes seconds
    from pisigma.network.trainer import Checkpoints

    robot, measurements = data.robot, data.training
    if data.fold_settings is not None:
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
    used = pairs.used_rows
    model = CalibratedModel(
        name=recipe.name,
        kind="inverse_calibration",
        robot=robot,
        network=network,
        domain=Domain.from_rows(network.scaled_inputs(pairs.T[used], pairs.q_nominal[used]), generator),
        branches=pairs.branches,
        starts=evenly_spaced_rows(measurements.q[used]),
        provenance=_provenance(recipe, measurements, pairs, recipe_sha256),
    )
    other = JointErrors.from_model(model, held_out) if held_out else None
    return TrainingRun(model, history, pairs, JointErrors.from_model(model, pairs), other, measurements)


def cross_validate(
    recipe: InverseRecipe,
    data: RecipeData,
    progress: Progress = lambda what: None,
    jobs: int | None = None,
) -> ComparisonFigures:
    """Cross-validate a recipe: train it without each fold, and compute the errors of that fold.

    Args:
        recipe: a recipe for measured data.
        data: its robot and rows. Every row is held out once.
        progress: called before every fold, except with `jobs`.
        jobs: see `TrainSettings`.

    Raises:
        RecipeError: the recipe simulates its data.
        MeasurementError: there are fewer different joint vectors than folds.
    """
    if data.fold_settings is None:
        raise RecipeError(
            f"expected a recipe for measured data, got '{recipe.name}', which simulates training and held-out rows",
            value=recipe.name,
        )
    measurements, folds = data.splits()
    with_orientation, not_predicted = measurements.rotation is not None, 0
    nominal, corrected = (PoseErrors.all_nan(measurements.rows, with_orientation) for _ in range(2))
    tasks = [
        partial(
            _compared_fold,
            recipe,
            replace(data, training=measurements.select(training)),
            measurements.select(test),
            partial(
                progress if jobs is None else no_progress, f"cross-validation: fold {number} of {len(folds)}"
            ),
        )
        for number, (training, test) in enumerate(folds, start=1)
    ]
    comparisons = (task() for task in tasks) if jobs is None else run_in_processes(tasks, jobs)
    for (_, test), comparison in zip(folds, comparisons, strict=True):
        not_predicted += comparison.rows_not_predicted
        nominal.set_rows(test, comparison.nominal)
        corrected.set_rows(test, comparison.corrected)
    return ComparisonFigures.from_comparison(Comparison(nominal, corrected, not_predicted), folds=len(folds))


def _compared_fold(
    recipe: InverseRecipe, data: RecipeData, test: Measurements, report_start: Callable[[], None]
) -> Comparison:
    """Train without a fold, and compare the model with the nominal robot on that fold."""
    report_start()
    return compare_with_nominal(train_networks(recipe, data).model, test)


def _check_one_pose(measurements: Measurements) -> None:
    """Check that all rows have one frame and one target, because an inverse calibration has one base and one tool.

    Raises:
        MeasurementError: there are several frames or targets; the message names the first row with a second name.
    """
    for what, names in (("frame", measurements.frame), ("target", measurements.target)):
        other = next((row for row, name in enumerate(names) if name != names[0]), None)
        if other is not None:
            raise MeasurementError(
                f"expected rows of one {what} for an inverse calibration, got '{names[other]}' in "
                f"{measurements.place(other)}, and '{names[0]}' in {measurements.place(0)}",
                value=names[other],
                option=what,
                remedy="give one file for each, or use `pisigma calibrate`",
            )


def _held_out_pairs(name: str, robot: Robot, held_out: Measurements) -> TrainingPairs:
    """Return pairs of held-out simulated poses; all poses must have a joint error.

    Raises:
        RecipeError: the nominal robot cannot reach some of the poses.
    """
    pairs = build_pairs(robot, held_out, None)
    if not pairs.used_rows.all():
        unreached = int((~pairs.used_rows).sum())
        raise RecipeError(
            f"recipe '{name}': the nominal robot cannot reach {unreached} of {len(pairs.used_rows)} poses of "
            "data.held_out, so they have no joint error; change their region.",
            value=unreached,
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
        rows=int(pairs.used_rows.sum()),
        rows_left_out=int((~pairs.used_rows).sum()),
        rule=pairs.left_out,
        seed=recipe.fit.seed,
        versions=Provenance.installed_versions(),
    )
