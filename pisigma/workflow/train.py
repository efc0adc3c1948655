"""Train the model of a recipe: typed settings in, a typed result out that writes itself as a model folder."""

import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from pisigma.errors import MeasurementError, RecipeError
from pisigma.identification.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.judging.calibration_summary import CalibrationSummary, summarise
from pisigma.judging.calibration_validation import (
    CalibrationValidation,
    errors_under,
    judge,
    learning_curve,
    validate,
)
from pisigma.judging.cross_validation import CrossValidation
from pisigma.judging.pose_statistics import Comparison, PoseErrors, compare_on
from pisigma.judging.training_summary import JointErrors, TrainingRun, TrainingSummary, summarise_training
from pisigma.judging.validation_figures import ErrorFigures, ValidationFigures
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import TrainTest, groups_of_equal_joints, k_folds
from pisigma.model.calibrated_model import CalibratedModel, Provenance
from pisigma.model.domain import Domain
from pisigma.model.folder.model_folder import save_model
from pisigma.model.folder.staging import staged_folder
from pisigma.model.stored_starts import spread_rows
from pisigma.recipes.data import load_measurements, simulate_held_out, simulate_repeats, simulate_training
from pisigma.recipes.reader import read_recipe, recipe_hash
from pisigma.recipes.recipe import (
    GeometricRecipe,
    HybridRecipe,
    InverseRecipe,
    MeasuredData,
    Recipe,
    SimulatedData,
)
from pisigma.reporting.calibration_card import CardTexts
from pisigma.reporting.training_card import write_training_card
from pisigma.robot.description import Robot
from pisigma.training.networks import fit_networks
from pisigma.training.pairs import TrainingPairs, build_pairs
from pisigma.training.patterns import build_network, build_patterns
from pisigma.training.sections import LevenbergMarquardtSection
from pisigma.training.trainer import Checkpoints
from pisigma.workflow.calibrate import Calibration, compose

Progress = Callable[[str], None]


@dataclass(frozen=True)
class TrainSettings:
    """How a training is run, apart from what it computes.

    Attributes:
        checkpoints: folder for checkpoints of networks, and of a hybrid on mini-batches; None keeps none. It is not
            removed when the training is done.
        resume: go on from the checkpoint there.
        show_progress: draw the bar of networks on stderr, if that is a terminal.
        logs: folder for Lightning's logs of networks: `metrics.csv`, and TensorBoard's events where it is installed.
    """

    checkpoints: Path | None = None
    resume: bool = False
    show_progress: bool = False
    logs: Path | None = None


@dataclass(frozen=True, eq=False)
class InverseTraining:
    """Networks on nominal joint values, trained and judged.

    Attributes:
        recipe: what was trained.
        run: what training gave: history, pairs, joint errors.
        validation: errors of rows under trainings without them, for measured data; None for simulated ones.
        test: errors of the rows that the data mark as test; None without such rows.
        summary: all figures.
        seconds: time it took [s].
    """

    recipe: InverseRecipe
    run: TrainingRun
    validation: CrossValidation | None
    test: Comparison | None
    summary: TrainingSummary
    seconds: float = 0.0

    @property
    def model(self) -> CalibratedModel:
        """What `pisigma.load` would read, with all figures as its metrics."""
        return replace(self.run.model, metrics=self.summary.to_json())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to heed, a sentence each."""
        rows = self.summary.rows
        return (f"{rows.left_out} rows were left out of the training: {rows.rule}.",) if rows.rule else ()

    def to_json(self) -> dict[str, Any]:
        """Give all figures as JSON values, in mm and deg."""
        return {"seconds": round(self.seconds, 3), **self.summary.to_json()}

    def save(
        self, folder: str | os.PathLike[str], name: str | None = None, command: str | None = None
    ) -> CalibratedModel:
        """Write the model folder with card and figures, whole or not at all; a model that is there is replaced.

        Args:
            folder: to write.
            name: of the model; None for the name of the folder.
            command: what made the model, for the card; None for the call of `train`.

        Returns:
            The model as written.

        Raises:
            OutputError: the folder holds something that is no model, or cannot be written.
        """
        command = command or f"pisigma.train({self.recipe.name!r})"
        summary = self.summary.model_copy(update={"command": command})
        name = name or Path(folder).resolve().name
        model = replace(self.model, name=name, metrics=summary.to_json())
        with staged_folder(folder) as scratch:
            save_model(model, scratch)
            texts = CardTexts(self.recipe.description, self.recipe.not_validated)
            write_training_card(name, texts, self.run, summary, scratch)
        return model


Training = InverseTraining | Calibration


def train(
    recipe: Recipe | str | os.PathLike[str],
    data: Measurements | str | os.PathLike[str] | None = None,
    settings: TrainSettings = TrainSettings(),
    progress: Progress = lambda what: None,
) -> Training:
    """Train the model of a recipe, and judge it on rows that it did not see.

    Args:
        recipe: of whatever kind, or its file.
        data: measured data or a CSV file of them, for a recipe that asks for them.
        settings: see `TrainSettings`.
        progress: called with what is being done.

    Returns:
        `InverseTraining` for a recipe of inverse calibration, else a `Calibration`.

    Raises:
        RecipeError: the recipe cannot be read, or has no use for data or settings.
        RobotError: its robot cannot be used.
        MeasurementError: the data cannot be used.
        IdentificationError: the data do not determine what is asked for.
        TrainingError: the training diverged, or there is no checkpoint of this recipe and data to resume.
        OutputError: checkpoints cannot be written.
    """
    started = time.perf_counter()
    sha256 = ""
    if isinstance(recipe, str | os.PathLike):
        path = recipe
        recipe, sha256 = read_recipe(path), recipe_hash(path)
    _refuse_useless(recipe, data is not None, settings)
    result: Training
    if isinstance(recipe, GeometricRecipe):
        result = _train_geometric(recipe, sha256)
    elif isinstance(recipe, HybridRecipe):
        result = _train_hybrid(recipe, sha256, data, settings, progress)
    else:
        result = _train_inverse(recipe, sha256, data, settings, progress)
    return replace(result, seconds=time.perf_counter() - started)


def _refuse_useless(recipe: Recipe, data: bool, settings: TrainSettings) -> None:
    """Refuse data and settings that a kind of recipe has no use for."""
    option = ""
    if isinstance(recipe, GeometricRecipe):
        option = "--data" if data else "--resume" if settings.resume else ""
    elif (
        isinstance(recipe, HybridRecipe) and settings.resume and recipe.hybrid.mini_batches in ("auto", False)
    ):
        option = "--resume"
    if option:
        raise RecipeError(
            f"recipe '{recipe.name}': a recipe of kind {recipe.kind} has no use for {option}; leave it out."
        )


def _train_geometric(recipe: GeometricRecipe, sha256: str) -> Calibration:
    robot = Robot.load(recipe.robot)
    rows, held_out = simulate_training(recipe), simulate_held_out(recipe)
    result = recipe.calibration.calibrator(robot).fit(rows)
    errors = ErrorFigures.model_validate(errors_under(result, held_out).in_file_units())
    summary = summarise(result).having(
        redundant_sets=tuple(tuple(members) for members in result.pairwise.sets),
        no_effect=tuple(result.pairwise.no_effect),
        pairwise_parameters=len(result.pairwise.kept),
        held_out=ValidationFigures(rows=held_out.rows, geometric=errors),
        paper=recipe.model_dump(mode="json")["paper"] or None,
    )
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose(robot, result, rows, summary, texts, recipe=(recipe.name, sha256))


def _train_hybrid(
    recipe: HybridRecipe,
    sha256: str,
    data: Measurements | str | os.PathLike[str] | None,
    settings: TrainSettings,
    progress: Progress,
) -> Calibration:
    rows, test_rows = load_measurements(recipe, data).split_sets()
    measured = isinstance(recipe.data, MeasuredData)
    if isinstance(recipe.data, MeasuredData):
        judged, splits = rows, k_folds(rows, recipe.data.folds, recipe.data.seed)
    else:
        judged, splits = simulate_repeats(recipe)
    calibrator = recipe.calibrator()
    started = time.perf_counter()
    result = calibrator.fit(
        rows, lambda what: progress(f"calibration: {what}"), settings.checkpoints, settings.resume
    )
    seconds = time.perf_counter() - started
    validation = validate(calibrator, judged, splits, lambda what: progress(f"held-out rows: {what}"))
    test = None if test_rows is None else judge(calibrator, result, rows, test_rows)
    summary = summarise(result).having(
        rows=rows.rows,
        fit_seconds=round(seconds, 3),
        cross_validation=validation.figures() if measured else None,
        test=None if test is None else test.figures(),
        held_out=None if measured else validation.figures(splits),
    )
    summary = _with_learning_curve(recipe, summary, judged, splits, validation, progress)
    texts = CardTexts(recipe.description, recipe.not_validated)
    return compose(
        Robot.load(recipe.robot),
        result,
        rows,
        summary,
        texts,
        validation,
        test,
        held_out=rows if measured else None,
        recipe=(recipe.name, sha256),
    )


def _with_learning_curve(
    recipe: HybridRecipe,
    summary: CalibrationSummary,
    rows: Measurements,
    splits: tuple[TrainTest, ...],
    validation: CalibrationValidation,
    progress: Progress,
) -> CalibrationSummary:
    stated = recipe.learning_curve
    if stated is None:
        return summary
    points = learning_curve(
        recipe.calibrator(),
        rows,
        splits,
        stated.rows,
        stated.seed,
        lambda what: progress(f"learning curve: {what}"),
        validation,
    )
    return summary.having(learning_curve=tuple(point.figures() for point in points))


def _train_inverse(
    recipe: InverseRecipe,
    sha256: str,
    data: Measurements | str | os.PathLike[str] | None,
    settings: TrainSettings,
    progress: Progress,
) -> InverseTraining:
    measurements, test_rows = load_measurements(recipe, data).split_sets()
    run = train_networks(recipe, measurements, settings, sha256)
    validation = test = None
    if isinstance(recipe.data, MeasuredData):
        validation = cross_validate(recipe, measurements, progress)
    if test_rows is not None:
        test = compare_on(run.model, test_rows)
    count = 0 if test_rows is None else test_rows.rows
    summary = summarise_training(run, recipe.paper, validation, test, count)
    return InverseTraining(recipe, run, validation, test, summary)


def train_networks(
    recipe: InverseRecipe,
    measurements: Measurements,
    settings: TrainSettings = TrainSettings(),
    recipe_sha256: str = "",
) -> TrainingRun:
    """Train the networks of a recipe, without judging them.

    Args:
        recipe: the recipe.
        measurements: its rows; those of the set "test" are not trained on.
        settings: checkpoints, progress and logs.
        recipe_sha256: of the recipe file, for provenance.

    Raises:
        PisigmaError: the data or the recipe do not allow it; the message says what to do.
    """
    measurements, _ = measurements.split_sets()
    robot = Robot.load(recipe.robot)
    if isinstance(recipe.data, MeasuredData):
        _check_one_pose(measurements)
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
        checkpoints=_checkpoints(recipe, measurements, settings),
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
    recipe: InverseRecipe, measurements: Measurements, progress: Progress = lambda what: None
) -> CrossValidation:
    """Train the recipe once per fold, on the other folds, and judge it on the fold.

    Args:
        recipe: for measured data.
        measurements: its rows to train on; every one is held out once.
        progress: called before every fold.

    Raises:
        RecipeError: the recipe simulates its data.
        MeasurementError: there are fewer different joint vectors than folds.
    """
    if not isinstance(recipe.data, MeasuredData):
        raise RecipeError(f"recipe '{recipe.name}' simulates its data; it has held-out rows of its own.")
    not_predicted = 0
    nominal = torch.full((2, measurements.rows), torch.nan, dtype=torch.float64)
    corrected = nominal.clone()
    folds = k_folds(measurements, recipe.data.folds, recipe.data.seed)
    for number, (training, test) in enumerate(folds, start=1):
        progress(f"cross-validation: fold {number} of {len(folds)}")
        model = train_networks(recipe, measurements.select(training)).model
        comparison = compare_on(model, measurements.select(test))
        not_predicted += comparison.not_predicted
        for store, errors in ((nominal, comparison.nominal), (corrected, comparison.corrected)):
            store[0, test] = errors.position
            if errors.rotation is not None:
                store[1, test] = errors.rotation
    rotated = measurements.rotation is not None
    before, after = (PoseErrors(store[0], store[1] if rotated else None) for store in (nominal, corrected))
    return CrossValidation(len(folds), Comparison(before, after, not_predicted))


def _checkpoints(
    recipe: InverseRecipe, measurements: Measurements, settings: TrainSettings
) -> Checkpoints | None:
    if settings.checkpoints is None:
        return None
    fingerprint = f"{recipe.model_dump_json()}|{measurements.content_hash()}"
    return Checkpoints(settings.checkpoints, fingerprint, settings.resume)


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


def _held_out_pairs(recipe: InverseRecipe, robot: Robot) -> TrainingPairs | None:
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
        versions={name: version(name) for name in ("pisigma", "torch")}
        | {"python": platform.python_version()},
    )
