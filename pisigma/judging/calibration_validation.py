"""Calibrations judged on held-out rows: nominal, geometric and hybrid side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.hybrid.result import HybridResult
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.judging.pose_statistics import PoseErrors, error_statistics
from pisigma.judging.predicted_spread import PredictedSpread, predicted_spread
from pisigma.judging.progress import Progress, stage
from pisigma.judging.trained_calibrations import (
    Calibrator,
    Result,
    geometric_of,
    judgeable,
    trained,
    with_frames,
    without_missing,
)
from pisigma.judging.validation_figures import LearningPoint, ValidationFigures
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import TrainTest, with_fewer
from pisigma.sensors.registry import SENSORS


@dataclass(frozen=True, eq=False)
class CalibrationValidation:
    """Errors of held-out rows, each under calibrations without it.

    In rows that were never held out they are NaN.

    Attributes:
        folds: number of folds; 1 where rows were held out once, 0 for rows that were kept apart from the start.
        models: by name: "nominal" (the nominal arm, base and tool fitted to the training rows), "geometric" and
            "hybrid" where it was asked for, which chooses its features on the training rows alone.
        spread: errors of positions beside what the hybrid predicts of them; None without one.
        distances: by model, predicted minus known distances of sockets that were held out [m].
        frames_fitted: how many frames were held out whole; where the base stands in them was fitted to the
            held-out rows themselves, under either arm.
        sockets_held_out: how many sockets were held out whole; their errors are from where their rows put the
            ball on average.
        not_judged: how many held-out rows have a target or an anchor that the rows calibrated with lack.
        again: the same for other folds, whose errors count in the figures too.
    """

    folds: int
    models: Mapping[str, PoseErrors]
    spread: PredictedSpread | None = None
    distances: Mapping[str, Float64[Tensor, " _pairs"]] = field(default_factory=dict)
    frames_fitted: int = 0
    sockets_held_out: int = 0
    not_judged: int = 0
    again: tuple["CalibrationValidation", ...] = ()

    @property
    def repeats(self) -> tuple["CalibrationValidation", ...]:
        """One validation for every repeat."""
        return (replace(self, again=()), *self.again)

    @property
    def all_errors(self) -> dict[str, PoseErrors]:
        """By model, errors of all rows in all repeats, one repeat after the other."""
        return {
            name: PoseErrors.joined([repeat.models[name] for repeat in self.repeats]) for name in self.models
        }

    @property
    def all_spread(self) -> PredictedSpread | None:
        """What a hybrid predicts of these errors."""
        spreads = [repeat.spread for repeat in self.repeats if repeat.spread is not None]
        return PredictedSpread.joined(spreads) if spreads else None

    def figures(self, simulations: Sequence[TrainTest] = ()) -> ValidationFigures:
        """The figures in mm and deg of all repeats.

        Args:
            simulations: training and test rows of each of several simulations; their RMS errors are listed one by one.
        """
        last = list(self.models.values())[-1]
        figures: dict[str, object] = {"folds": self.folds} if self.folds else {}
        figures["rows"] = int(torch.isfinite(last.position).sum())
        if self.again:
            figures["repeats"] = len(self.repeats)
            figures["rms_mm_of_repeats"] = {
                name: tuple(_rms_mm(one.models[name].position) for one in self.repeats)
                for name in self.models
            }
        figures |= {name: errors.figures for name, errors in self.all_errors.items()}
        if self.all_spread is not None:
            figures |= self.all_spread.in_file_units()
        count = max((len(errors) for errors in self.distances.values()), default=0)
        if count:
            sizes = {
                name: _sizes(torch.cat([one.distances[name] for one in self.repeats]))
                for name in self.distances
            }
            figures["socket_distance"] = {"count": count, **sizes}
        counts = {"frames_fitted": self.frames_fitted, "sockets_held_out": self.sockets_held_out}
        counts["rows_not_judged"] = max(repeat.not_judged for repeat in self.repeats)
        figures |= {name: count for name, count in counts.items() if count}
        if simulations:
            rms = {
                name: tuple(_rms_mm(errors.position[test]) for _, test in simulations)
                for name, errors in self.models.items()
            }
            figures["rms_mm_of_simulations"] = rms
            figures["mean_rms_mm"] = {name: sum(values) / len(values) for name, values in rms.items()}
        return ValidationFigures.model_validate(figures)


class _Judged:
    """What is gathered of all models: errors of held-out rows, and of known distances of held-out sockets."""

    def __init__(self, measurements: Measurements) -> None:
        units = {SENSORS[kind].unit for kind in measurements.kinds if kind in SENSORS}
        self._turned = measurements.rotation is not None or "rad" in units
        self._rows = measurements.rows
        self._errors: dict[str, PoseErrors] = {}
        self._distances: dict[str, list[Tensor]] = {}
        self._spread: PredictedSpread | None = None

    def add(self, name: str, errors: PoseErrors, distances: Tensor, test: Tensor) -> None:
        """Errors of some rows under one model."""
        if name not in self._errors:
            self._errors[name] = PoseErrors.none(self._rows, self._turned)
            self._distances[name] = []
        self._errors[name].put(test, errors)
        self._distances[name].append(distances)

    def add_spread(self, spread: PredictedSpread, test: Tensor) -> None:
        """Errors of positions of some rows and what was predicted of them."""
        if self._spread is None:
            self._spread = PredictedSpread.none(self._rows)
        self._spread.error[test], self._spread.sigma[test] = spread.error, spread.sigma

    def validation(
        self, folds: int, frames: int = 0, sockets: int = 0, left_out: int = 0
    ) -> CalibrationValidation:
        """Everything together."""
        distances = {name: torch.cat(errors) for name, errors in self._distances.items()}
        return CalibrationValidation(folds, self._errors, self._spread, distances, frames, sockets, left_out)


def validate(
    calibrator: Calibrator,
    measurements: Measurements,
    splits: Sequence[TrainTest],
    progress: Progress = lambda what: None,
) -> CalibrationValidation:
    """Calibrate on the training rows of every split and judge on its test rows.

    Args:
        calibrator: the calibration; "nominal" is the geometric one with no parameter of the arm free and no row
            downweighted. Whatever it chooses, it chooses on the training rows.
        measurements: the rows.
        splits: from `k_folds` or `holdout`.
        progress: called with the fold that is being judged, and what is being tried.

    Raises:
        IdentificationError: the training rows of a split do not determine what is asked for, or no test row has a
            target or anchor that its training rows have too.
    """
    judged = _Judged(measurements)
    frames = sockets = left_out = 0
    for done, (train, test) in enumerate(splits):
        fold = f"fold {done + 1} of {len(splits)}"
        progress(fold)
        training = measurements.select(train)
        judged_rows = test[judgeable(measurements, test, training)]
        left_out += len(test) - len(judged_rows)
        held_out = measurements.select(judged_rows)
        frames += len(set(held_out.frame) - set(training.frame))
        sockets += len(_sockets(held_out) - _sockets(training))
        chosen = without_missing(calibrator, training, measurements)
        try:
            results = trained(chosen, training, stage(progress, fold))
        except IdentificationError as problem:
            raise IdentificationError(
                f"{fold}, calibrated with {training.rows} of the {measurements.rows} rows: {problem} All rows at once "
                "may do: leave out the cross-validation, or ask for more folds."
            ) from None
        _judge(judged, geometric_of(calibrator), results, training, (held_out, judged_rows))
    return judged.validation(len(splits), frames, sockets, left_out)


def validate_repeatedly(
    calibrator: Calibrator,
    measurements: Measurements,
    repeats: Sequence[Sequence[TrainTest]],
    progress: Progress = lambda what: None,
) -> CalibrationValidation:
    """Validate on several repeats of folds; see `validate` and `pisigma.measurement.splits.repeats`."""
    if len(repeats) == 1:
        return validate(calibrator, measurements, repeats[0], progress)
    first, *again = (
        validate(
            calibrator, measurements, splits, stage(progress, f"repeat {number} of {len(repeats)}", ", ")
        )
        for number, splits in enumerate(repeats, 1)
    )
    return replace(first, again=tuple(again))


def learning_curve(
    calibrator: Calibrator,
    measurements: Measurements,
    splits: Sequence[TrainTest],
    sizes: Sequence[int],
    seed: int,
    progress: Progress = lambda what: None,
    whole: CalibrationValidation | None = None,
) -> tuple[LearningPoint, ...]:
    """Calibrate with fewer and fewer of the training rows of every split, and judge on all its test rows.

    Args:
        calibrator: see `validate`.
        measurements: the rows.
        splits: training and test rows.
        sizes: numbers of training rows.
        seed: decides which rows are drawn; smaller draws are subsets of larger ones.
        progress: called with what is being done.
        whole: what all training rows gave, as the last point of the curve; None for none.

    Returns:
        The figures of the points, fewest rows first.

    Raises:
        MeasurementError: a split has fewer training rows than are wanted.
        IdentificationError: so few rows do not determine what is asked for.
    """
    points = []
    for rows in sorted(sizes):
        fewer = with_fewer(measurements, splits, rows, seed)
        of_rows = stage(progress, f"{rows} training rows")
        points.append((rows, validate(calibrator, measurements, fewer, of_rows)))
    if whole is not None:
        points.append((min(len(train) for train, _ in splits), whole))
    figures = ((rows, validation.figures().model_dump(exclude_unset=True)) for rows, validation in points)
    return tuple(
        LearningPoint.model_validate({**values, "rows": rows, "held_out": values["rows"]})
        for rows, values in figures
    )


def judge(
    calibrator: Calibrator, result: Result, training: Measurements, test: Measurements
) -> CalibrationValidation:
    """Judge a calibration on rows that were kept apart.

    Args:
        calibrator: what calibrated, for the "nominal" figures; see `validate`.
        result: what it gave.
        training: the rows that it was fitted to.
        test: other rows.

    Raises:
        IdentificationError: a test row has a frame or target that was not calibrated.
    """
    judged = _Judged(test)
    results = trained(calibrator, training, result=result)
    _judge(judged, None, results, training, (test, torch.arange(test.rows)))
    return judged.validation(0)


def _judge(
    judged: _Judged,
    calibrator: GeometricCalibrator | None,
    results: Mapping[str, Result],
    training: Measurements,
    held_out: tuple[Measurements, Tensor],
) -> None:
    """Judge all models on held-out rows, with frames that they lack fitted by a calibrator, if there is one."""
    rows, test = held_out
    for name, fitted in results.items():
        result = fitted if calibrator is None else with_frames(calibrator, fitted, rows)
        stated = {} if calibrator is None else calibrator.socket_distances
        judged.add(name, errors_under(result, rows), _distance_errors(stated, result, training, rows), test)
        if isinstance(result, HybridResult):
            judged.add_spread(predicted_spread(result, rows), test)


def errors_under(result: Result, measurements: Measurements) -> PoseErrors:
    """Errors of any rows under a calibration, whatever sensor measured them.

    Returns:
        As "position" the length of the error of whatever length a row has: of a position or a ball in a socket the
        distance, of a touch, a wire or a pair the difference [m]. As "rotation" the same of whatever angle it has.

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


def _distance_errors(
    stated: Mapping[tuple[str, str], float], result: Result, training: Measurements, rows: Measurements
) -> Float64[Tensor, " pairs"]:
    """Predicted minus known distance of sockets that are in these rows but not in the training rows [m].

    A socket is where its rows put the ball on average.
    """
    names, held_out = rows.socket or (), _sockets(rows) - _sockets(training)
    pairs = {pair: distance for pair, distance in stated.items() if set(pair) <= held_out}
    if not pairs:
        return torch.zeros(0, dtype=torch.float64)
    T = result.predicted_poses(rows)
    ball = T[:, :3, 3].detach().cpu()
    centre = {
        name: ball[torch.tensor([other == name for other in names])].mean(0)
        for name in {name for pair in pairs for name in pair}
    }
    return torch.stack([(centre[a] - centre[b]).norm() - distance for (a, b), distance in pairs.items()])


def _sockets(rows: Measurements) -> set[str]:
    return set(rows.socket or ()) - {""}


def _rms_mm(errors: Float64[Tensor, " rows"]) -> float:
    return error_statistics(errors)["rms"] * 1e3


def _sizes(errors: Float64[Tensor, " pairs"]) -> dict[str, float]:
    """Mean and largest of the errors' sizes [mm]."""
    return {"mean_mm": float(errors.abs().mean()) * 1e3, "max_mm": float(errors.abs().max()) * 1e3}
