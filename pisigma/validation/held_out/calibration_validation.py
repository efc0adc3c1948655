"""Cross-validation of calibrations: errors of held-out rows under the nominal, geometric and hybrid calibration."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.engines.processes import run_in_processes, run_in_threads
from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress, no_progress, with_stage
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import SENSORS
from pisigma.measurement.sensors.socket import PairOfSockets
from pisigma.measurement.splits import TrainTest, with_fewer_training_rows
from pisigma.validation.held_out.pose_statistics import (
    ErrorsWithPredictedSigma,
    PoseErrors,
    error_statistics,
    errors_with_predicted_sigma,
)
from pisigma.validation.held_out.trained_calibrations import (
    Calibrator,
    DistanceErrors,
    Result,
    assign_distances_to_folds,
    distance_figures,
    drop_missing_frames,
    fit_compared_calibrations,
    geometric_of,
    judgeable_rows,
    with_missing_frames,
)
from pisigma.validation.held_out.validation_figures import LearningPoint, ValidationFigures

_FEW_ROWS = 500
"""Number of rows up to which folds are calibrated in parallel threads; larger folds need all of the memory."""


@dataclass(frozen=True, eq=False)
class CalibrationValidation:
    """Errors of held-out rows, each under calibrations without that row; NaN for rows that were never held out.

    Attributes:
        folds: number of folds; 1 if rows were held out once, 0 for a separate test set.
        errors_by_model: errors under "nominal" (the nominal arm with base and tool fitted to the training rows),
            "geometric", and "hybrid" if requested, which selects its features using only the training rows.
        spread: position errors with their predicted standard deviations under the hybrid; None without a hybrid.
        distances: errors of held-out stated distances between sockets.
        frames_held_out: number of frames that were held out completely; their bases were fitted to the held-out rows.
        sockets_held_out: number of sockets that were held out completely; their errors are relative to the mean
            predicted position of the ball.
        rows_not_judged: number of held-out rows that could not be evaluated, because no training row has their target
            or anchor.
        further_repeats: validations with other folds (repeats), whose errors are included in the figures.
    """

    folds: int
    errors_by_model: Mapping[str, PoseErrors]
    spread: ErrorsWithPredictedSigma | None = None
    distances: DistanceErrors = field(default_factory=DistanceErrors)
    frames_held_out: int = 0
    sockets_held_out: int = 0
    rows_not_judged: int = 0
    further_repeats: tuple["CalibrationValidation", ...] = ()

    @property
    def repeats(self) -> tuple["CalibrationValidation", ...]:
        """The validations of all repeats."""
        return (replace(self, further_repeats=()), *self.further_repeats)

    @property
    def all_errors(self) -> dict[str, PoseErrors]:
        """Errors of all rows in all repeats by model, one repeat after the other."""
        return {
            name: PoseErrors.concatenate([repeat.errors_by_model[name] for repeat in self.repeats])
            for name in self.errors_by_model
        }

    @property
    def predicted_spread(self) -> ErrorsWithPredictedSigma | None:
        """Position errors and their predicted standard deviations in all repeats; None without a hybrid."""
        spreads = [repeat.spread for repeat in self.repeats if repeat.spread is not None]
        return ErrorsWithPredictedSigma.concatenate(spreads) if spreads else None

    def figures(self, simulations: Sequence[TrainTest] = ()) -> ValidationFigures:
        """Compute the statistics of all repeats in mm and deg.

        Args:
            simulations: training and test rows of each of several simulations, whose RMS errors are listed
                individually.
        """
        last = list(self.errors_by_model.values())[-1]
        figures: dict[str, object] = {"folds": self.folds} if self.folds else {}
        figures["rows"] = int(torch.isfinite(last.position).sum())
        if self.further_repeats:
            figures["repeats"] = len(self.repeats)
            figures["rms_mm_of_repeats"] = {
                name: tuple(_rms_mm(one.errors_by_model[name].position) for one in self.repeats)
                for name in self.errors_by_model
            }
        figures |= {name: errors.figures for name, errors in self.all_errors.items()}
        if self.predicted_spread is not None:
            figures |= self.predicted_spread.in_file_units()
        if (distances := distance_figures([one.distances for one in self.repeats])) is not None:
            figures["socket_distance"] = distances.model_dump(exclude_unset=True)
        counts = {"frames_fitted": self.frames_held_out, "sockets_held_out": self.sockets_held_out}
        counts["rows_not_judged"] = max(repeat.rows_not_judged for repeat in self.repeats)
        figures |= {name: count for name, count in counts.items() if count}
        if simulations:
            rms = {
                name: tuple(_rms_mm(errors.position[test]) for _, test in simulations)
                for name, errors in self.errors_by_model.items()
            }
            figures["rms_mm_of_simulations"] = rms
            figures["mean_rms_mm"] = {name: sum(values) / len(values) for name, values in rms.items()}
        return ValidationFigures.model_validate(figures)


@dataclass(frozen=True, eq=False)
class JudgedFold:
    """Result of one fold: errors of its held-out rows under all models.

    Attributes:
        test_rows: indices of the held-out rows.
        errors_by_model: their errors by model.
        distances: errors of stated distances between sockets that its calibration did not use.
        spread: position errors and their predicted standard deviations under the hybrid.
        frames_held_out: number of frames that were held out completely.
        sockets_held_out: number of sockets that were held out completely.
        rows_not_judged: number of held-out rows that could not be evaluated.
    """

    test_rows: Int64[Tensor, " rows"]
    errors_by_model: Mapping[str, PoseErrors]
    distances: DistanceErrors
    spread: ErrorsWithPredictedSigma | None
    frames_held_out: int = 0
    sockets_held_out: int = 0
    rows_not_judged: int = 0


def _joined(measurements: Measurements, judged: Sequence[JudgedFold], folds: int) -> CalibrationValidation:
    """Combine the folds, in the order of the rows."""
    units = {SENSORS[kind].unit for kind in measurements.kinds if kind in SENSORS}
    turned = measurements.rotation is not None or "rad" in units
    errors = {name: PoseErrors.all_nan(measurements.rows, turned) for name in judged[0].errors_by_model}
    spread = None
    for fold in judged:
        for name, of_fold in fold.errors_by_model.items():
            errors[name].set_rows(fold.test_rows, of_fold)
        if fold.spread is not None:
            spread = spread or ErrorsWithPredictedSigma.all_nan(measurements.rows)
            spread.error[fold.test_rows], spread.sigma[fold.test_rows] = fold.spread.error, fold.spread.sigma
    distances = DistanceErrors.concatenate([fold.distances for fold in judged])
    frames, sockets, not_judged = (
        sum(getattr(fold, count) for fold in judged)
        for count in ("frames_held_out", "sockets_held_out", "rows_not_judged")
    )
    return CalibrationValidation(folds, errors, spread, distances, frames, sockets, not_judged)


def validate(
    calibrator: Calibrator,
    measurements: Measurements,
    splits: Sequence[TrainTest],
    progress: Progress = lambda what: None,
    jobs: int | None = None,
) -> CalibrationValidation:
    """Calibrate on the training rows of every split, and compute the errors of its test rows.

    Args:
        calibrator: the calibrator; "nominal" is its geometric calibrator without free parameters of the arm and with
            full weight of all rows. Features and outliers are selected using only the training rows.
        measurements: the rows.
        splits: splits of `k_folds` or `holdout`.
        progress: called with the current fold and trial; not called from other processes.
        jobs: number of processes for the splits, with one thread each; None for threads of this process.

    Raises:
        IdentificationError: the training rows of a split do not determine the parameters, or they share no target or
            anchor with its test rows.
    """
    judged = judged_folds(calibrator, measurements, [splits], progress, jobs)
    return joined_repeats(measurements, [splits], judged)


def judged_folds(
    calibrator: Calibrator,
    measurements: Measurements,
    repeats: Sequence[Sequence[TrainTest]],
    progress: Progress = lambda what: None,
    jobs: int | None = None,
) -> Iterator[JudgedFold]:
    """Evaluate every fold of every repeat, in threads or processes; see `fold_tasks` and `validate`."""
    tasks = fold_tasks(calibrator, measurements, repeats, progress if jobs is None else no_progress)
    return (
        run_in_threads(tasks, measurements.rows > _FEW_ROWS)
        if jobs is None
        else run_in_processes(tasks, jobs)
    )


def fold_tasks(
    calibrator: Calibrator,
    measurements: Measurements,
    repeats: Sequence[Sequence[TrainTest]],
    progress: Progress,
) -> list[Callable[[], JudgedFold]]:
    """Make the functions that evaluate every fold of every repeat.

    Args:
        calibrator: see `validate`.
        measurements: the rows.
        repeats: training and test rows of every fold, per repeat; see `pisigma.measurement.splits.repeats`.
        progress: called with the current fold and trial.
    """
    tasks: list[Callable[[], JudgedFold]] = []
    for number, splits in enumerate(repeats, 1):
        of_repeat = progress
        if len(repeats) > 1:
            of_repeat = with_stage(progress, f"repeat {number} of {len(repeats)}", ", ")
        held_out = assign_distances_to_folds(geometric_of(calibrator).socket_distances, measurements, splits)
        for fold, (split, without) in enumerate(zip(splits, held_out, strict=True), 1):
            name = f"fold {fold} of {len(splits)}"
            tasks.append(partial(_judged_fold, calibrator, measurements, name, split, without, of_repeat))
    return tasks


def joined_repeats(
    measurements: Measurements, repeats: Sequence[Sequence[TrainTest]], judged_folds: Iterator[JudgedFold]
) -> CalibrationValidation:
    """Combine the evaluated folds of all repeats, in the order of `fold_tasks`."""
    first, *again = [
        _joined(measurements, [next(judged_folds) for _ in splits], len(splits)) for splits in repeats
    ]
    return replace(first, further_repeats=tuple(again))


def _judged_fold(
    calibrator: Calibrator,
    measurements: Measurements,
    fold: str,
    split: TrainTest,
    distances: Mapping[PairOfSockets, float],
    progress: Progress,
) -> JudgedFold:
    """Calibrate on the training rows of a split without some distances, and evaluate these and the test rows."""
    progress(fold)
    train, test = split
    training = measurements.select(train)
    judged_rows = test[judgeable_rows(measurements, test, training)]
    held_out = measurements.select(judged_rows)
    chosen = drop_missing_frames(calibrator, training, measurements, distances)
    try:
        results = fit_compared_calibrations(chosen, training, with_stage(progress, fold))
    except IdentificationError as problem:
        raise IdentificationError(
            f"{fold}, calibrated with {training.rows} of the {measurements.rows} rows: {problem} A calibration with "
            "all rows may be possible: omit the cross-validation, or use more folds.",
            value=fold,
        ) from None
    everything = measurements.select(torch.cat([train, judged_rows]))
    judged = _judge(geometric_of(calibrator), results, held_out, distances, everything)
    return replace(
        judged,
        test_rows=judged_rows,
        frames_held_out=len(set(held_out.frame) - set(training.frame)),
        sockets_held_out=len(_sockets(held_out) - _sockets(training)),
        rows_not_judged=len(test) - len(judged_rows),
    )


def learning_curve(
    calibrator: Calibrator,
    measurements: Measurements,
    splits: Sequence[TrainTest],
    row_counts: Sequence[int],
    seed: int,
    progress: Progress = lambda what: None,
    full_training: CalibrationValidation | None = None,
    jobs: int | None = None,
) -> tuple[LearningPoint, ...]:
    """Compute the errors of the test rows as a function of the number of training rows.

    Args:
        calibrator: see `validate`.
        measurements: the rows.
        splits: training and test rows.
        row_counts: numbers of training rows.
        seed: random seed of the selection of training rows; smaller selections are subsets of larger ones.
        progress: called with the current step.
        full_training: validation with all training rows, as the last point of the curve; None to omit it.
        jobs: see `validate`.

    Returns:
        The points of the curve, fewest rows first.

    Raises:
        MeasurementError: a split has fewer training rows than requested.
        IdentificationError: a number of rows is too small to determine the parameters.
    """
    points = []
    for rows in sorted(row_counts):
        fewer = with_fewer_training_rows(measurements, splits, rows, seed)
        of_rows = with_stage(progress, f"{rows} training rows")
        points.append((rows, validate(calibrator, measurements, fewer, of_rows, jobs)))
    if full_training is not None:
        points.append((min(len(train) for train, _ in splits), full_training))
    figures = ((rows, validation.figures().model_dump(exclude_unset=True)) for rows, validation in points)
    return tuple(
        LearningPoint.model_validate({**values, "rows": rows, "held_out": values["rows"]})
        for rows, values in figures
    )


def judge(
    calibrator: Calibrator, result: Result, training: Measurements, test: Measurements
) -> CalibrationValidation:
    """Evaluate a calibration on a separate test set.

    Args:
        calibrator: the calibrator, for the "nominal" errors; see `validate`.
        result: result of the calibrator.
        training: the rows to which the calibration was fitted.
        test: the rows of the test set.

    Raises:
        IdentificationError: a test row has a frame or target that was not calibrated.
    """
    results = fit_compared_calibrations(calibrator, training, result=result)
    return _joined(test, [_judge(None, results, test, {}, test)], 0)


def _judge(
    calibrator: GeometricCalibrator | None,
    results: Mapping[str, Result],
    held_out: Measurements,
    distances: Mapping[PairOfSockets, float],
    rows: Measurements,
) -> JudgedFold:
    """Evaluate all models on held-out rows; a calibrator, if given, fits missing frames.

    Held-out distances between sockets are evaluated on all rows.
    """
    if calibrator is not None:
        results = {
            name: with_missing_frames(calibrator, fitted, held_out) for name, fitted in results.items()
        }
    errors = {name: pose_errors_of(result, held_out) for name, result in results.items()}
    hybrid = results.get("hybrid")
    spread = errors_with_predicted_sigma(hybrid, held_out) if isinstance(hybrid, HybridResult) else None
    poses = {name: result.predicted_poses(rows) for name, result in results.items() if distances}
    apart = DistanceErrors.from_poses(poses, distances, rows)
    return JudgedFold(torch.arange(held_out.rows), errors, apart, spread)


@runtime_checkable
class ErrorPredictor(Protocol):
    """A calibration of any kind."""

    def errors_of(self, measurements: Measurements) -> Mapping[str, Float64[Tensor, "rows components"]]:
        """Compute measured minus predicted values by sensor [m or rad]; see `CalibrationResult.errors_of`."""


def pose_errors_of(result: ErrorPredictor, measurements: Measurements) -> PoseErrors:
    """Compute the errors of rows of any sensor under a calibration.

    Returns:
        `position` contains the length of the error of a row's measured length [m]: the distance for a position or a
        ball in a socket, the difference for a touch, a wire or a pair. `rotation` contains the angle of its orientation
        error [rad].

    Raises:
        IdentificationError: a row has a frame, target or anchor that was not calibrated.
    """
    lengths = torch.full((measurements.rows,), torch.nan, dtype=torch.float64)
    rotation: Tensor | None = None
    for sensor, errors in result.errors_of(measurements).items():
        size = torch.as_tensor(errors).norm(dim=-1)
        if SENSORS[sensor].unit == "rad":
            rotation = size if rotation is None else torch.where(torch.isfinite(size), size, rotation)
        else:
            lengths = torch.where(torch.isfinite(size), size, lengths)
    return PoseErrors(lengths, rotation)


def _sockets(rows: Measurements) -> set[str]:
    return set(rows.socket or ()) - {""}


def _rms_mm(errors: Float64[Tensor, " rows"]) -> float:
    return error_statistics(errors)["rms"] * 1e3
