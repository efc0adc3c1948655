"""Calibrations fitted to the same training rows, to be compared by their predictions of other rows."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.estimation.loss import SquaredLoss
from pisigma.files.errors import IdentificationError
from pisigma.files.progress import Progress
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.socket import PairOfSockets, SocketSensor
from pisigma.measurement.splits import TrainTest
from pisigma.robot.description import Robot
from pisigma.validation.held_out.validation_figures import (
    MODELS,
    DistanceFigures,
    SocketDistances,
    StatedDistance,
)

Calibrator = GeometricCalibrator | HybridCalibrator
Result = CalibrationResult | HybridResult


def geometric_of(calibrator: Calibrator) -> GeometricCalibrator:
    """Return the geometric calibrator, which a hybrid calibrator contains."""
    return calibrator.geometric_calibrator if isinstance(calibrator, HybridCalibrator) else calibrator


def geometric_result(result: Result) -> CalibrationResult:
    """Return the geometric calibration, on which a hybrid is based."""
    return result.geometric if isinstance(result, HybridResult) else result


def fit(calibrator: Calibrator, rows: Measurements, progress: Progress) -> Result:
    """Calibrate with a geometric or hybrid calibrator, and return the result.

    Args:
        calibrator: a calibrator of either kind.
        rows: the rows to calibrate with.
        progress: called with the current trial of a hybrid.
    """
    return (
        calibrator.fit(rows, progress) if isinstance(calibrator, HybridCalibrator) else calibrator.fit(rows)
    )


def fit_compared_calibrations(
    calibrator: Calibrator,
    rows: Measurements,
    progress: Progress = lambda what: None,
    result: Result | None = None,
) -> dict[str, Result]:
    """Return all calibrations that are compared, fitted to the same rows.

    Args:
        calibrator: a calibrator of either kind.
        rows: the rows to calibrate with.
        progress: called with the current trial.
        result: result of the calibrator for these rows; None to calibrate.

    Returns:
        Results by name: "nominal" (the nominal arm with base and tool fitted, all rows with full weight),
        "geometric", and "hybrid" for a hybrid calibrator.

    Raises:
        IdentificationError: the rows do not determine the parameters.
    """
    nominal = base_and_tool_calibrator(geometric_of(calibrator)).fit(rows)
    result = fit(calibrator, rows, progress) if result is None else result
    results: dict[str, Result] = {"nominal": nominal, "geometric": geometric_result(result)}
    return results | ({"hybrid": result} if isinstance(result, HybridResult) else {})


def base_and_tool_calibrator(calibrator: GeometricCalibrator) -> GeometricCalibrator:
    """Return the calibrator of the nominal arm: only base and tool are fitted, and all rows have full weight."""
    return replace(calibrator, free=(), loss=SquaredLoss())


def drop_missing_frames(
    calibrator: Calibrator,
    rows: Measurements,
    all_rows: Measurements,
    held_out: Collection[PairOfSockets] = (),
) -> Calibrator:
    """Return a calibrator without stated frames and socket distances that the rows lack.

    Args:
        calibrator: calibrator for all rows.
        rows: the rows to which the calibrator will be fitted.
        all_rows: rows of all folds; frames and distances that all of these rows lack are kept, so that the calibrator
            refuses them.
        held_out: further socket distances to remove.
    """
    if isinstance(calibrator, HybridCalibrator):
        geometric = drop_missing_frames(calibrator.geometric_calibrator, rows, all_rows, held_out)
        assert isinstance(geometric, GeometricCalibrator)
        return replace(calibrator, robot=geometric)
    no_frame = set(all_rows.frame) - set(rows.frame)
    no_socket = (set(all_rows.socket or ()) - set(rows.socket or ())) - {""}
    return replace(
        calibrator,
        base_guesses={name: base for name, base in calibrator.base_guesses.items() if name not in no_frame},
        socket_distances={
            pair: distance
            for pair, distance in calibrator.socket_distances.items()
            if not no_socket & set(pair) and pair not in held_out
        },
    )


def with_missing_frames(calibrator: GeometricCalibrator, result: Result, rows: Measurements) -> Result:
    """Return a calibration with the bases of missing frames fitted to the rows in these frames.

    Args:
        calibrator: the calibrator of the geometric calibration.
        result: the calibration; for a hybrid, the bases are fitted with and without the joint correction.
        rows: held-out rows, some of them in frames that were not calibrated.

    Returns:
        The calibration with these bases added.

    Raises:
        IdentificationError: there are several targets, or the rows do not determine the base in their frame.
    """
    geometric = geometric_result(result)
    missing = set(rows.frame) - set(geometric.bases)
    if not missing:
        return result
    if len(geometric.tools) > 1:
        raise IdentificationError(
            f"frame '{min(missing)}' is held out, which requires a single target, but there are "
            f"{', '.join(sorted(geometric.tools))}",
            value=tuple(sorted(geometric.tools)),
            remedy="split by joints or by time",
        )
    chosen = torch.tensor([name in missing for name in rows.frame]).nonzero()[:, 0]
    missed = rows.select(chosen)
    bases = geometric.bases | _bases(calibrator, geometric.robot, missed)
    if not isinstance(result, HybridResult):
        return replace(result, bases=bases)
    learned = result.learned
    if learned is not None:
        with torch.no_grad():
            moved = replace(missed, q=missed.q + learned.correction.for_rows(missed))
        learned_bases = learned.geometry.bases | _bases(calibrator, learned.geometry.robot, moved)
        learned = replace(learned, geometry=replace(learned.geometry, bases=learned_bases))
    return replace(result, geometric=replace(geometric, bases=bases), learned=learned)


def _bases(
    calibrator: GeometricCalibrator, robot: Robot, rows: Measurements
) -> dict[str, Float64[np.ndarray, " 6"]]:
    """Return the bases of an arm in the frames of the rows, which all have full weight."""
    frames = set(rows.frame)
    only_bases = replace(
        calibrator,
        robot=robot,
        free=(),
        base="free",
        tool="fixed",
        loss=SquaredLoss(),
        base_guesses={name: base for name, base in calibrator.base_guesses.items() if name in frames},
        socket_distances={},
    )
    return only_bases.fit(rows).bases


def judgeable_rows(measurements: Measurements, test_indices: Tensor, training: Measurements) -> Tensor:
    """Return the mask of test rows whose target and anchor (unless stated) also occur in training rows.

    Args:
        measurements: all rows.
        test_indices: indices of the test rows.
        training: the training rows.

    Returns:
        One boolean per test row.

    Raises:
        IdentificationError: no test row can be evaluated.
    """
    targets, anchors = set(training.target), {*(training.anchor or ()), ""}
    names = measurements.anchor or ("",) * measurements.rows
    place = measurements.anchor_place
    placed = (
        torch.zeros(len(test_indices), dtype=torch.bool)
        if place is None
        else place[test_indices].isfinite().all(-1)
    )
    rows = test_indices.tolist()
    rows_judged = [
        measurements.target[row] in targets and (names[row] in anchors or is_placed)
        for row, is_placed in zip(rows, placed.tolist(), strict=True)
    ]
    if not any(rows_judged):
        raise IdentificationError(
            "neither this row nor any other row held out with it has both a target and an anchor that occur in the "
            "training rows",
            at=measurements.place_of(rows[0]),
            remedy="measure more poses with each, or omit the cross-validation",
        )
    return torch.tensor(rows_judged, device=test_indices.device)


@dataclass(frozen=True, eq=False)
class DistanceErrors:
    """Errors of stated distances between sockets.

    Attributes:
        stated_distances: stated distances by the names of two sockets [m].
        errors: predicted minus stated distances by model, in the same order [m].
    """

    stated_distances: Mapping[PairOfSockets, float] = field(default_factory=dict)
    errors: Mapping[str, Float64[Tensor, " pairs"]] = field(default_factory=dict)

    @staticmethod
    def from_poses(
        poses: Mapping[str, Float64[Tensor, "rows 4 4"]],
        stated_distances: Mapping[PairOfSockets, float],
        rows: Measurements,
    ) -> "DistanceErrors":
        """Return the errors under several calibrations, with sockets at the mean predicted position of their balls.

        Args:
            poses: predicted poses of the target in every row, by name of a calibration that does not use these
                distances.
            stated_distances: the distances [m].
            rows: the rows, including those of the sockets.
        """
        errors, sockets = {}, tuple({one for pair in stated_distances for one in pair})
        for model, T in poses.items():
            centre = {
                name: SocketSensor.uncalibrated_unknowns(rows, name, T.detach().cpu(), ()) for name in sockets
            }
            errors[model] = torch.tensor(
                [
                    float((centre[a] - centre[b]).norm()) - distance
                    for (a, b), distance in stated_distances.items()
                ],
                dtype=torch.float64,
            )
        return DistanceErrors(stated_distances, errors)

    @staticmethod
    def concatenate(parts: "Sequence[DistanceErrors]") -> "DistanceErrors":
        """Concatenate the errors of several folds."""
        there = [part for part in parts if part.stated_distances]
        stated = {pair: distance for part in there for pair, distance in part.stated_distances.items()}
        names = there[0].errors if there else ()
        return DistanceErrors(
            stated, {name: torch.cat([part.errors[name] for part in there]) for name in names}
        )


def assign_distances_to_folds(
    stated_distances: Mapping[PairOfSockets, float], measurements: Measurements, splits: Sequence[TrainTest]
) -> tuple[dict[PairOfSockets, float], ...]:
    """Assign every stated distance to one fold, whose calibration does not use it.

    If a fold has no rows of one of the sockets, the distance is assigned to that fold. Otherwise distances are assigned
    to the folds cyclically, as long as one distance remains in the fold, because a calibration without distances does
    not determine the scale. Distances of a socket that occurs in no row are assigned to no fold, so that the
    calibrations refuse them.
    """
    names = measurements.socket or ()
    known = [{names[row] for row in train.tolist()} if names else set() for train, _ in splits]
    folds: tuple[dict[PairOfSockets, float], ...] = tuple({} for _ in splits)
    for number, (pair, distance) in enumerate(stated_distances.items()):
        if not set(pair) <= set(names):
            continue
        lacking = [fold for fold, sockets in enumerate(known) if not set(pair) <= sockets]
        fold = lacking[0] if lacking else number % len(splits)
        left = [
            one
            for one in stated_distances
            if set(one) <= known[fold] and one != pair and one not in folds[fold]
        ]
        if lacking or (left and len(splits) > 1):
            folds[fold][pair] = distance
    return folds


def distance_figures(repeats: Sequence[DistanceErrors]) -> SocketDistances | None:
    """Return the figures of several repeats [mm]; None if no distance was evaluated."""
    repeats = [one for one in repeats if one.stated_distances]
    if not repeats:
        return None
    of_each: dict[PairOfSockets, dict[str, list[float]]] = {}
    for one in repeats:
        for number, pair in enumerate(one.stated_distances):
            for name, errors in one.errors.items():
                of_each.setdefault(pair, {}).setdefault(name, []).append(float(errors[number]) * 1e3)
    stated = {pair: distance * 1e3 for one in repeats for pair, distance in one.stated_distances.items()}
    sizes = {
        name: DistanceFigures(mean_mm=float(errors.mean()) * 1e3, max_mm=float(errors.max()) * 1e3)
        for name in repeats[0].errors
        if name in MODELS
        for errors in [torch.cat([one.errors[name] for one in repeats]).abs()]
    }
    each = tuple(
        StatedDistance(
            sockets=pair,
            stated_mm=stated[pair],
            errors_mm={name: sum(values) / len(values) for name, values in errors.items()},
        )
        for pair, errors in sorted(of_each.items())
    )
    return SocketDistances.model_validate({"count": len(each), **sizes, "each": each})
