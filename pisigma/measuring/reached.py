"""How accurate a calibration with the rows so far is, and what the poses that are left would bring."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import IdentificationError, MeasurementError
from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.hybrid.result import HybridResult
from pisigma.judging.calibration_validation import errors_under, validate
from pisigma.judging.few_rows import fit_where_it_helps
from pisigma.judging.progress import Progress
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds
from pisigma.measuring.state import AccuracyPoint
from pisigma.planning.expected_accuracy import curve, p95_of, rms_of
from pisigma.planning.knowledge import Knowledge
from pisigma.planning.plan_file import StoredPlan
from pisigma.robot.description import Robot

FOLDS = 5
"""Of the cross-validation."""


@dataclass(frozen=True, eq=False)
class Reached:
    """What the rows so far have come to.

    Attributes:
        point: accuracy of a calibration with them.
        knowledge: what is known after them.
    """

    point: AccuracyPoint
    knowledge: Knowledge


def reached_so_far(
    plan: StoredPlan,
    before: Knowledge,
    rows: Measurements,
    check: Measurements | None,
    task: Float64[Tensor, "tasks dof"],
    progress: Progress = lambda what: None,
) -> Reached | None:
    """What the rows of a plan came to; None where they are too few as yet, or contradict each other.

    Args:
        plan: for a model, which takes the rows as they come, or for a robot as drawn, which is calibrated with them.
        before: what was known before the first of them.
        rows: see `reached`, as for the next three.
        check: see there; unused with a model.
        task: see there.
        progress: see there.
    """
    if not rows.rows:
        return None
    try:
        if plan.model is not None:
            return reached_with(before, rows, task)
        return reached(plan.arm.robot, before, rows, check, task, progress)
    except (IdentificationError, MeasurementError):
        return None


def reached(
    robot: Robot,
    before: Knowledge,
    rows: Measurements,
    check: Measurements | None,
    task: Float64[Tensor, "tasks dof"],
    progress: Progress = lambda what: None,
) -> Reached:
    """Calibrate with the rows so far, and judge that by its posterior, by left-out rows and by rows that check it.

    Args:
        robot: as drawn.
        before: what is known of a robot that was never measured, and what measures.
        rows: to calibrate with.
        check: rows that are kept apart; None where there are none yet.
        task: joint values [rad or m] where the robot shall be accurate.
        progress: called with what is being done.

    Raises:
        IdentificationError: the rows are too few, or contradict each other.
    """
    calibrator = HybridCalibrator(robot)
    result = fit_where_it_helps(calibrator, rows, progress)
    assert isinstance(result, HybridResult)
    if result.learned is None and np.array_equal(result.geometric.robot.dh, robot.dh):
        # Too few rows left the arm as drawn, so that the posterior says nothing of its errors.
        knowledge = before.informed(rows.q)
    else:
        knowledge = Knowledge.of_result(result, before.instrument)
    D = knowledge.tool(task)
    errors = validate(calibrator, rows, k_folds(rows, min(FOLDS, rows.rows), seed=0), progress).models[
        "hybrid"
    ]
    checked = torch.full((1,), math.nan, dtype=torch.float64)
    if check is not None:
        checked = errors_under(result, check).position
    point = AccuracyPoint(rows.rows, rms_of(D), p95_of(D), *_rms_p95(errors.position), *_rms_p95(checked))
    return Reached(point, knowledge)


def reached_with(before: Knowledge, rows: Measurements, task: Float64[Tensor, "tasks dof"]) -> Reached:
    """Say what rows add to what a model knows already, whatever their values.

    Args:
        before: what the model knows.
        rows: measured since.
        task: see `reached`.
    """
    knowledge = before.informed(rows.q)
    D = knowledge.tool(task)
    return Reached(AccuracyPoint(rows.rows, rms_of(D), p95_of(D)), knowledge)


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
