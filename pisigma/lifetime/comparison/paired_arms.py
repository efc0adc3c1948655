"""Compare the joint values of two arms in the same postures, such as a leader and a follower: zeros that differ."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import t as student

from pisigma.files.errors import MeasurementError
from pisigma.model.calibrated_model import CalibratedModel

Moved = Literal["leader", "follower", "unknown"]
FALSE_ALARMS = 1e-3
"""Probability that a joint of a pair of arms without differences is named."""
TOLERANCE = math.radians(0.5)
"""Smallest difference that is named [rad]: backlash and gravity shift the means of servos by such angles."""
BLOCKS, MIN_ROWS = 20, 10
"""Blocks of consecutive rows, whose means are independent although neighbouring rows of a log are not."""
CERTAIN = 5.0
"""Log odds above which the arm that moved is named."""
ITERATIONS = 10


@dataclass(frozen=True, eq=False)
class ZeroChanges:
    """Changes of the zeros of an arm since its calibration.

    Attributes:
        values: changes [rad], to be added to its joint values.
        covariance: their covariance [rad²].
    """

    values: Float64[np.ndarray, " joints"]
    covariance: Float64[np.ndarray, "joints joints"]


@dataclass(frozen=True)
class JointDifference:
    """Difference of the joint values of two arms in the same postures.

    Attributes:
        joint: name of the joint.
        value: follower minus leader [rad].
        standard_error: its standard error [rad].
        differs: whether it is significant and larger than the tolerance.
        moved: the arm whose zero moved, if the joint differs; "unknown" without measured positions that show it.
    """

    joint: str
    value: float
    standard_error: float
    differs: bool
    moved: Moved | None


def estimate_zero_changes(
    model: CalibratedModel, q: Float64[np.ndarray, "rows joints"], position: Float64[np.ndarray, "rows 3"]
) -> ZeroChanges:
    """Fit changes of all zeros of an arm to measured positions of its tool; base and tool are those of the model.

    The covariance is estimated from the residuals of every row (White 1980), because the noise of servos depends on
    the posture.

    Args:
        model: calibrated model of the arm.
        q: joint values [rad].
        position: measured positions of its tool [m] in the frame of the model.

    Raises:
        MeasurementError: there are not enough rows.
    """
    rows, joints = q.shape
    if 3 * rows < 3 * joints:
        raise MeasurementError(
            expected=f"at least {joints} rows with positions", value=rows, option="position"
        )
    values = torch.zeros(joints, dtype=torch.float64)
    measured = torch.from_numpy(np.array(position))
    for _ in range(ITERATIONS):
        there = torch.from_numpy(np.array(q)) + values
        J = model.jacobian(there)[:, :3]
        residual = measured - model.forward(there)[:, :3, 3]
        inverse = torch.linalg.pinv((J.mT @ J).sum(0), hermitian=True)
        values = values + inverse @ (J.mT @ residual[..., None]).sum(0)[:, 0]
    score = (J.mT @ residual[..., None])[..., 0]
    scale = 3 * rows / max(3 * rows - joints, 1)
    covariance = scale * inverse @ (score.mT @ score) @ inverse
    # Directions that the positions do not show have no covariance in the pseudo-inverse: they are unknown.
    hidden = torch.eye(joints, dtype=torch.float64) - inverse @ (J.mT @ J).sum(0)
    return ZeroChanges(values.numpy(), (covariance + math.pi**2 * hidden @ hidden.mT).numpy())


def compare_paired_arms(
    leader: Float64[np.ndarray, "rows joints"],
    follower: Float64[np.ndarray, "rows joints"],
    names: tuple[str, ...],
    *,
    leader_zeros: ZeroChanges | None = None,
    follower_zeros: ZeroChanges | None = None,
    tolerance: float = TOLERANCE,
) -> tuple[JointDifference, ...]:
    """Compare the joint values of two arms of one kind that were in the same postures, row by row.

    The postures have to be the same in space, for example in a jig or at the same touched points. Logs of
    teleoperation do not show differences, because the follower is commanded to the joint values of the leader.

    Args:
        leader: its joint values [rad], in the order of their recording.
        follower: those of the follower.
        names: names of the joints.
        leader_zeros: changes of the leader's zeros since its calibration, see `estimate_zero_changes`.
        follower_zeros: those of the follower's zeros.
        tolerance: smallest difference that is named [rad].

    Returns:
        One difference per joint, which is significant if a pair without differences would have one as large in less
        than one of 1,000 comparisons.

    Raises:
        MeasurementError: the arrays do not have one value per joint and row, or there are fewer than 10 rows.
    """
    if leader.shape != follower.shape or leader.ndim != 2 or leader.shape[1] != len(names):
        raise MeasurementError(
            expected=f"two arrays of rows of {len(names)} joint values",
            value=f"{leader.shape} and {follower.shape}",
            option="leader, follower",
        )
    if len(leader) < MIN_ROWS or not np.isfinite(leader).all() or not np.isfinite(follower).all():
        raise MeasurementError(
            expected=f"at least {MIN_ROWS} rows of numbers", value=len(leader), option="leader"
        )
    blocks = np.array_split(follower - leader, min(BLOCKS, len(leader) // 2))
    means = np.array([block.mean(0) for block in blocks])
    error = means.std(0, ddof=1) / math.sqrt(len(blocks))
    limit = float(student.isf(FALSE_ALARMS / len(names) / 2, len(blocks) - 1))
    found = []
    for index, name in enumerate(names):
        value, sigma = float(means[:, index].mean()), float(error[index])
        differs = abs(value) > max(limit * sigma, tolerance)
        odds = _log_odds(value, sigma, index, leader_zeros, follower_zeros)
        moved: Moved = "unknown" if abs(odds) < CERTAIN else "follower" if odds > 0 else "leader"
        found.append(JointDifference(name, value, sigma, differs, moved if differs else None))
    return tuple(found)


def _log_odds(
    value: float, sigma: float, index: int, leader: ZeroChanges | None, follower: ZeroChanges | None
) -> float:
    """Return the log odds that the follower's zero moved, not the leader's.

    The follower's zero has to move by -value or the leader's by value to explain the difference.
    """
    total = 0.0
    for arm, sign in ((follower, -1.0), (leader, 1.0)):
        if arm is not None:
            change, variance = float(arm.values[index]), float(arm.covariance[index, index]) + sigma**2
            total -= sign * (change**2 - (change - sign * value) ** 2) / (2 * variance)
    return total
