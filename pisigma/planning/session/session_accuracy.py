"""Accuracy of a calibration with the rows so far, and expected benefit of the remaining poses."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.files.progress import Progress
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds
from pisigma.planning.expected_accuracy import accuracy_curve, p95_of, rms_of
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.robot_posterior import RobotPosterior
from pisigma.planning.session.state import AccuracyPoint
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_validation import pose_errors_of, validate
from pisigma.validation.held_out.few_rows import fit_if_better

_FOLDS = 5
"""Number of folds of the cross-validation."""


@dataclass(frozen=True, eq=False)
class SessionAccuracy:
    """Accuracy and posterior given the rows so far.

    Attributes:
        point: accuracy of a calibration with these rows.
        posterior: posterior given these rows.
        rows: the rows; None with a model, whose posterior is updated by their joint values alone.
    """

    point: AccuracyPoint
    posterior: RobotPosterior
    rows: Measurements | None = None


def session_accuracy(
    plan: StoredPlan,
    prior: RobotPosterior,
    rows: Measurements,
    test_rows: Measurements | None,
    task: Float64[Tensor, "tasks dof"],
    progress: Progress = lambda what: None,
) -> SessionAccuracy | None:
    """Compute accuracy and posterior given the rows of a plan; None if these are too few or contradictory.

    Args:
        plan: plan for a nominal robot, which is calibrated with the rows, or for a model, whose posterior is updated by
            their joint values alone.
        prior: prior of the session, including the instrument.
        rows: rows to calibrate with.
        test_rows: rows that test the calibration; None if there are none yet. They are not used with a model.
        task: joint values at which the robot must be accurate [rad or m].
        progress: called with the name of each step.
    """
    if not rows.rows:
        return None
    checked = (math.nan, math.nan)
    if plan.model is not None:
        posterior = prior.after_measuring(rows.q)
    else:
        try:
            posterior, checked = _calibrated(plan.arm.robot, prior, rows, test_rows, progress)
        except (IdentificationError, MeasurementError):
            return None
    D = posterior.tool_derivatives(task)
    point = AccuracyPoint(rows.rows, rms_of(D), p95_of(D), checked_rms=checked[0], checked_p95=checked[1])
    return SessionAccuracy(point, posterior, rows if plan.model is None else None)


def _calibrated(
    robot: Robot, before: RobotPosterior, rows: Measurements, check: Measurements | None, progress: Progress
) -> tuple[RobotPosterior, tuple[float, float]]:
    """Calibrate, and compute RMS and 95 % quantile of the errors of the test rows [m].

    Raises:
        IdentificationError: the rows are too few, or contradict each other.
        MeasurementError: too few rows can be held out.
    """
    result = fit_if_better(HybridCalibrator(robot), rows, progress)
    assert isinstance(result, HybridResult)
    if result.learned is None and np.array_equal(result.geometric.robot.dh, robot.dh):
        # with too few rows, the arm remains nominal, so the posterior of the fit does not contain the errors of the arm
        posterior = before.after_measuring(rows.q)
    else:
        posterior = RobotPosterior.from_result(result, before.instrument)
    if check is None:
        return posterior, (math.nan, math.nan)
    return posterior, _rms_p95(pose_errors_of(result, check).position)


def with_cross_validation(
    robot: Robot, accuracy_so_far: SessionAccuracy, progress: Progress = lambda what: None
) -> AccuracyPoint:
    """Return the accuracy with cross-validated errors, if the rows allow a cross-validation.

    Args:
        robot: nominal robot.
        accuracy_so_far: accuracy and posterior given the rows so far.
        progress: callback that is called with the name of each step; an exception that it raises ends the computation.
    """
    rows = accuracy_so_far.rows
    if rows is None:
        return accuracy_so_far.point
    try:
        folds = k_folds(rows, min(_FOLDS, rows.rows), seed=0)
        errors = validate(HybridCalibrator(robot), rows, folds, progress).errors_by_model["hybrid"].position
    except (IdentificationError, MeasurementError):
        return accuracy_so_far.point
    rms, p95 = _rms_p95(errors)
    return replace(accuracy_so_far.point, cross_validated_rms=rms, cross_validated_p95=p95)


def expected_accuracy(
    posterior: RobotPosterior,
    measured_poses: int,
    poses: Float64[Tensor, "poses dof"],
    candidates: Float64[Tensor, "candidates dof"],
    task: Float64[Tensor, "tasks dof"],
    poses_per_point: int,
) -> tuple[AccuracyPoint, ...]:
    """Predict the accuracy after the remaining poses, and after the same number of random candidates.

    Args:
        posterior: posterior given the rows so far.
        measured_poses: number of poses so far.
        poses: joint values of the remaining poses, beginning with the next [rad or m].
        candidates: joint values of poses that could be measured instead [rad or m].
        task: joint values at which the robot must be accurate [rad or m].
        poses_per_point: number of poses between two points of the curve.
    """
    counts = [*range(poses_per_point, len(poses), poses_per_point), len(poses)] if len(poses) else []
    both = torch.cat([poses, candidates])
    points = accuracy_curve(
        posterior.sensitivities(both), posterior.tool_derivatives(task), torch.arange(len(poses)), counts
    )
    return tuple(
        AccuracyPoint(measured_poses + point.poses, point.rms, point.p95, random_rms=point.random_rms)
        for point in points
    )


def _rms_p95(errors: Float64[Tensor, " rows"]) -> tuple[float, float]:
    """Return the root mean square and the 95 % quantile of errors [m]; NaN if there are no errors."""
    errors = errors[errors.isfinite()]
    if not len(errors):
        return math.nan, math.nan
    return float(errors.square().mean().sqrt()), float(errors.quantile(0.95))
