"""How accurate a calibration with the rows so far is, and what the poses that are left would bring."""

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
from pisigma.planning.expected_accuracy import curve, p95_of, rms_of
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.session.state import AccuracyPoint
from pisigma.robot.description import Robot
from pisigma.validation.held_out.calibration_validation import errors_under, validate
from pisigma.validation.held_out.few_rows import fit_where_it_helps

FOLDS = 5
"""Of the cross-validation."""


@dataclass(frozen=True, eq=False)
class Reached:
    """What the rows so far have come to.

    Attributes:
        point: accuracy of a calibration with them.
        knowledge: what is known after them.
        rows: that were calibrated with; None with a model, to which they are added whatever their values.
    """

    point: AccuracyPoint
    knowledge: Knowledge
    rows: Measurements | None = None


def reached(
    plan: StoredPlan,
    before: Knowledge,
    rows: Measurements,
    check: Measurements | None,
    task: Float64[Tensor, "tasks dof"],
    progress: Progress = lambda what: None,
) -> Reached | None:
    """Say what the rows of a plan came to; None where they are too few as yet, or contradict each other.

    Args:
        plan: for a robot as drawn, which is calibrated with the rows, or for a model, to which they are added whatever
            their values.
        before: what was known before the first row, and what measures.
        rows: to calibrate with.
        check: rows that are kept apart; None where there are none yet. Unused with a model.
        task: joint values [rad or m] where the robot shall be accurate.
        progress: called with what is being done.
    """
    if not rows.rows:
        return None
    checked = (math.nan, math.nan)
    if plan.model is not None:
        knowledge = before.informed(rows.q)
    else:
        try:
            knowledge, checked = _calibrated(plan.arm.robot, before, rows, check, progress)
        except (IdentificationError, MeasurementError):
            return None
    D = knowledge.tool(task)
    point = AccuracyPoint(rows.rows, rms_of(D), p95_of(D), checked_rms=checked[0], checked_p95=checked[1])
    return Reached(point, knowledge, rows if plan.model is None else None)


def _calibrated(
    robot: Robot, before: Knowledge, rows: Measurements, check: Measurements | None, progress: Progress
) -> tuple[Knowledge, tuple[float, float]]:
    """Calibrate, and judge that by rows that check it: RMS and 95 % [m].

    Raises:
        IdentificationError: the rows are too few, or contradict each other.
        MeasurementError: too few of them can be left out.
    """
    result = fit_where_it_helps(HybridCalibrator(robot), rows, progress)
    assert isinstance(result, HybridResult)
    if result.learned is None and np.array_equal(result.geometric.robot.dh, robot.dh):
        # Too few rows left the arm as drawn, so that the posterior says nothing of its errors.
        knowledge = before.informed(rows.q)
    else:
        knowledge = Knowledge.of_result(result, before.instrument)
    if check is None:
        return knowledge, (math.nan, math.nan)
    return knowledge, _rms_p95(errors_under(result, check).position)


def cross_validated(robot: Robot, so_far: Reached, progress: Progress = lambda what: None) -> AccuracyPoint:
    """Return the accuracy with the errors of rows that are left out, where they can be.

    Args:
        robot: as drawn.
        so_far: what the rows came to.
        progress: called with what is being done; what it raises ends the calculation.
    """
    rows = so_far.rows
    if rows is None:
        return so_far.point
    try:
        folds = k_folds(rows, min(FOLDS, rows.rows), seed=0)
        errors = validate(HybridCalibrator(robot), rows, folds, progress).models["hybrid"].position
    except (IdentificationError, MeasurementError):
        return so_far.point
    rms, p95 = _rms_p95(errors)
    return replace(so_far.point, cross_validated_rms=rms, cross_validated_p95=p95)


def expected(
    knowledge: Knowledge,
    measured: int,
    poses: Float64[Tensor, "poses dof"],
    candidates: Float64[Tensor, "candidates dof"],
    task: Float64[Tensor, "tasks dof"],
    step: int,
) -> tuple[AccuracyPoint, ...]:
    """Predict what the poses that are left will bring, beside as many of the candidates at random.

    Args:
        knowledge: after the rows so far.
        measured: number of poses so far.
        poses: that are left, the next one first [rad or m].
        candidates: that could be measured instead [rad or m].
        task: see `reached`.
        step: poses between two points.
    """
    counts = [*range(step, len(poses), step), len(poses)] if len(poses) else []
    both = torch.cat([poses, candidates])
    points = curve(knowledge.measured(both), knowledge.tool(task), torch.arange(len(poses)), counts)
    return tuple(
        AccuracyPoint(measured + point.poses, point.rms, point.p95, random_rms=point.random_rms)
        for point in points
    )


def _rms_p95(errors: Float64[Tensor, " rows"]) -> tuple[float, float]:
    """Root mean square, and what 95 % of the errors stay below [m]; NaN of none."""
    errors = errors[errors.isfinite()]
    if not len(errors):
        return math.nan, math.nan
    return float(errors.square().mean().sqrt()), float(errors.quantile(0.95))
