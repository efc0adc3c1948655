"""Find different joint zeros of two arms, such as a leader and a follower, from joint values in the same postures."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import t as student

from pisigma.files.errors import MeasurementError, Phrase
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.robot_class import RobotClass
from pisigma.robot.se3 import wrap_to_pi

Verdict = Literal["different", "same", "unknown"]
Moved = Literal["leader", "follower", "both", "unknown"]
_FALSE_ALARMS = 1e-3
"""Probability that a joint is named although the two arms do not differ."""
_MISSED = 0.025
"""Probability that a joint whose difference equals the tolerance is called the same."""
TOLERANCE = math.radians(0.5)
"""Smallest difference that is named [rad], because backlash and gravity shift the means of servos by such angles."""
_BLOCKS, _MIN_ROWS = 20, 10
"""Number of blocks of consecutive rows, whose means are independent although neighbouring rows of a log are not, and
smallest number of rows."""
_CERTAIN = 5.0
"""Log odds above which the arm that moved is named."""
_ITERATIONS = 10
_SMALLEST_NOISE = 1e-6
"""Smallest standard deviation of positions [m], which keeps directions without information regular."""


@dataclass(frozen=True, eq=False)
class ZeroChanges:
    """Changes of the zeros of an arm since its calibration.

    Attributes:
        values: changes [rad], which are added to the joint values of the arm.
        covariance: covariance of the changes [rad²].
    """

    values: Float64[np.ndarray, " joints"]
    covariance: Float64[np.ndarray, "joints joints"]


@dataclass(frozen=True)
class JointDifference:
    """Difference of the joint values of two arms in the same postures.

    Attributes:
        joint: name of the joint.
        follower_minus_leader: follower minus leader [rad], in (-pi, pi].
        standard_error: standard error of the difference [rad].
        verdict: "different" if the difference is significant and larger than the tolerance, "same" if it is smaller
            than the tolerance with a confidence of 97.5 %, otherwise "unknown", which more rows would decide.
        moved_arm: the arm whose zero moved, if the joint is different; "both" if the measured positions of an arm
            exclude that only one zero moved, "unknown" if they do not show which zero moved.
    """

    joint: str
    follower_minus_leader: float
    standard_error: float
    verdict: Verdict
    moved_arm: Moved | None


def estimate_zero_changes(
    model: CalibratedModel, q: Float64[np.ndarray, "rows joints"], position: Float64[np.ndarray, "rows 3"]
) -> ZeroChanges:
    """Fit changes of all zeros of an arm to measured positions of its tool; base and tool are those of the model.

    The prior standard deviation of a change is pi, which remains for zeros that the positions do not determine. The
    covariance is estimated from the residuals of every row (White 1980), because the noise of servos depends on the
    posture.

    Args:
        model: calibrated model of the arm.
        q: joint values [rad].
        position: measured positions of the tool [m] in the frame of the model.

    Raises:
        MeasurementError: the arrays do not belong to this arm or to each other, there are fewer than 10 rows, or no
            changes of zeros explain the positions.
    """
    rows, joints = len(q), model.robot.dof
    if q.shape != (rows, joints) or position.shape != (rows, 3):
        raise MeasurementError(
            expected=f"rows of {joints} joint values and of 3 coordinates",
            value=Phrase(f"{q.shape} and {position.shape}"),
            option="q, position",
        )
    _check_rows(q, "q")
    _check_rows(position, "position")
    values, measured = torch.zeros(joints, dtype=torch.float64), torch.from_numpy(np.array(position))
    weight = torch.eye(joints, dtype=torch.float64) / math.pi**2
    for _ in range(_ITERATIONS):
        there = torch.from_numpy(np.array(q)) + values
        J = model.jacobian(there)[:, :3]
        residual = measured - model.forward(there)[:, :3, 3]
        variance = residual.square().sum() / max(3 * rows - joints, 1) + _SMALLEST_NOISE**2
        inverse = torch.linalg.inv((J.mT @ J).sum(0) + variance * weight)
        score = (J.mT @ residual[..., None])[..., 0]
        values = values + inverse @ (score.sum(0) - variance * weight @ values)
    _check_explained(model, math.sqrt(3 * float(variance)))
    scale = 3 * rows / max(3 * rows - joints, 1)
    covariance = inverse @ (scale * score.mT @ score + variance**2 * weight) @ inverse
    return ZeroChanges(values.numpy(), covariance.numpy())


def _check_rows(rows: Float64[np.ndarray, "rows columns"], option: str) -> None:
    """Check that there are enough rows of numbers.

    Raises:
        MeasurementError: there are too few rows, or they contain other values than numbers.
    """
    if len(rows) < _MIN_ROWS or not np.isfinite(rows).all():
        finite = int(np.isfinite(rows).all(1).sum())
        raise MeasurementError(
            expected=f"at least {_MIN_ROWS} rows of finite numbers",
            value=Phrase(f"{finite} of {len(rows)}"),
            option=option,
        )


def _check_explained(model: CalibratedModel, rms: float) -> None:
    """Check that the positions fit the arm with changed zeros, up to errors [m] that robots of its class have.

    Raises:
        MeasurementError: the positions do not fit.
    """
    limit = RobotClass.from_robot(model.robot).max_calibrated_error_per_reach * model.robot.reach
    if rms > limit:
        raise MeasurementError(
            "no shifts of the joint zeros explain the positions",
            expected=f"residuals below {limit * 1e3:.2g} mm RMS",
            value=f"{rms * 1e3:.3g} mm",
            option="position",
            remedy="give positions in m in the frame of the model, and the joint values of the same rows in rad; if "
            "they are right, calibrate this arm again",
        )


def compare_paired_arms(
    leader: Float64[np.ndarray, "rows joints"],
    follower: Float64[np.ndarray, "rows joints"],
    names: tuple[str, ...],
    *,
    leader_zeros: ZeroChanges | None = None,
    follower_zeros: ZeroChanges | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[JointDifference, ...]:
    """Compare the joint values of two arms of the same type in the same postures, row by row.

    The postures must be the same in space, for example in a jig or at the same touched points. Logs of teleoperation do
    not show differences, because the follower is commanded to the joint values of the leader.

    Args:
        leader: joint values of the leader [rad], whose joints are revolute, in the order of recording; full turns do
            not matter.
        follower: joint values of the follower [rad].
        names: names of the joints.
        leader_zeros: changes of the leader's zeros since its calibration, see `estimate_zero_changes`.
        follower_zeros: changes of the follower's zeros.
        tolerance: smallest difference that is named [rad].

    Returns:
        One difference per joint, which is significant if arms without differences would show one as large in fewer than
        one of 1,000 comparisons.

    Raises:
        MeasurementError: the arrays do not have one value per joint and row, there are fewer than 10 rows, or both
            arrays are the same.
    """
    if leader.shape != follower.shape or leader.ndim != 2 or leader.shape[1] != len(names):
        raise MeasurementError(
            expected=f"two arrays of rows of {len(names)} joint values",
            value=Phrase(f"{leader.shape} and {follower.shape}"),
            option="leader, follower",
        )
    _check_rows(leader, "leader")
    _check_rows(follower, "follower")
    if np.array_equal(leader, follower):
        raise MeasurementError(
            "the joint values of both arms are identical in every row, so they are not measured independently",
            expected="joint values that each arm measured",
            value="the same values twice",
            option="leader, follower",
        )
    difference = follower - leader
    center = np.angle(np.exp(1j * difference).mean(0))
    difference = center + wrap_to_pi(torch.from_numpy(difference - center)).numpy()
    blocks = np.array_split(difference, min(_BLOCKS, len(leader) // 2))
    means = np.array([block.mean(0) for block in blocks])
    error = means.std(0, ddof=1) / math.sqrt(len(blocks))
    freedom = len(blocks) - 1
    limit = float(student.isf(_FALSE_ALARMS / len(names) / 2, freedom))
    found = []
    for index, name in enumerate(names):
        value, sigma = float(means[:, index].mean()), float(error[index])
        verdict: Verdict = "unknown"
        if abs(value) > max(limit * sigma, tolerance):
            verdict = "different"
        elif abs(value) + float(student.isf(_MISSED, freedom)) * sigma < tolerance:
            verdict = "same"
        changes = [_change(zeros, index) for zeros in (leader_zeros, follower_zeros)]
        moved = _moved(value, sigma, changes, limit, tolerance) if verdict == "different" else None
        found.append(JointDifference(name, value, sigma, verdict, moved))
    return tuple(found)


def _change(zeros: ZeroChanges | None, index: int) -> tuple[float, float] | None:
    """Return the shift of the zero of a joint [rad] and its variance [rad²]; None if it was not measured."""
    return None if zeros is None else (float(zeros.values[index]), float(zeros.covariance[index, index]))


def _moved(
    value: float, sigma: float, changes: list[tuple[float, float] | None], limit: float, tolerance: float
) -> Moved:
    """Return the arm whose zero moved, from the changes of the leader's and the follower's zero.

    To explain the difference, the leader's zero must have changed by `value`, or the follower's by `-value`, while the
    zero of the other arm did not change. An explanation is excluded if a measured change deviates from it by as much as
    a difference that is named.
    """
    arms: tuple[Moved, Moved] = ("leader", "follower")
    misfit, excluded = {}, {}
    for arm, expected in zip(arms, ((value, 0.0), (0.0, -value)), strict=True):
        gaps = [
            (change[0] - there, change[1] + sigma**2)
            for change, there in zip(changes, expected, strict=True)
            if change is not None
        ]
        misfit[arm] = sum(gap**2 / variance for gap, variance in gaps)
        excluded[arm] = any(abs(gap) > max(limit * math.sqrt(variance), tolerance) for gap, variance in gaps)
    likely: Moved = min(arms, key=lambda arm: misfit[arm])
    if all(excluded.values()):
        return "both"
    return (
        "unknown" if excluded[likely] or abs(misfit["leader"] - misfit["follower"]) < 2 * _CERTAIN else likely
    )
