"""Pose accuracy and repeatability of poses that were measured more than once, for example in a session."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names
from pisigma.validation.iso9283.pose import barycentre, position_accuracy, position_repeatability

CYCLES = 30
"""Number of repeats of a pose that ISO 9283:1998 requires."""
MIN_CYCLES = 10
"""Number of repeats below which RP is not computed, because few distances underestimate the spread."""


@dataclass(frozen=True)
class RepeatedPose:
    """ISO 9283 figures of a pose that was measured more than once.

    Attributes:
        rows: number of measurements of the pose.
        accuracy: pose accuracy AP_P [m]: distance from the commanded position, which the model predicts, to the
            barycentre of the measured positions; None if the model does not have the frame of the rows.
        repeatability: pose repeatability RP_l [m]; None with fewer than `MIN_CYCLES` measurements.
        sum_of_squares: sum of the squared distances from the barycentre [m²].
    """

    rows: int
    accuracy: float | None
    repeatability: float | None
    sum_of_squares: float

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, with lengths in mm."""
        ap, rp = (None if value is None else value * 1e3 for value in (self.accuracy, self.repeatability))
        return {"rows": self.rows, "ap_mm": ap, "rp_mm": rp}


def pooled_scatter(poses: Sequence[RepeatedPose]) -> tuple[float, int] | None:
    """Return the pooled scatter of one coordinate over poses that were measured more than once.

    `s² = Σ_poses Σ_j |x_j - x̄|² / (3 Σ_poses (n - 1))`, with `3 Σ (n - 1)` degrees of freedom; s contains the noise
    of the instrument.

    Returns:
        The standard deviation of a coordinate [m] and its degrees of freedom; None without repeats.
    """
    freedom = 3 * sum(one.rows - 1 for one in poses)
    return (math.sqrt(sum(one.sum_of_squares for one in poses) / freedom), freedom) if freedom else None


def repeated_poses(
    rows: Measurements, commanded: Float64[Tensor, "rows 3"] | None
) -> tuple[RepeatedPose, ...]:
    """Compute AP_P of poses with two or more measured positions, and RP_l of poses with `MIN_CYCLES` or more.

    Args:
        rows: measured rows; rows of one pose have exactly equal joint values, frames and targets.
        commanded: commanded position of every row, in the frame of the row [m]; None if it is not known.
    """
    if rows.position is None:
        return ()
    joints = groups_of_equal_joints(rows.q, tolerance=0.0).tolist()
    pose = numbers_of_names(list(zip(joints, rows.frame, rows.target, strict=True)))
    found = []
    for number in range(int(pose.max()) + 1):
        of_pose = (pose == number) & torch.isfinite(rows.position).all(-1)
        attained = rows.position[of_pose]
        if len(attained) > 1:
            accuracy = None
            if commanded is not None:
                accuracy = float(position_accuracy(attained, commanded[of_pose][0]).length)
            repeatability = float(position_repeatability(attained)) if len(attained) >= MIN_CYCLES else None
            squares = float((attained - barycentre(attained)).square().sum())
            found.append(RepeatedPose(len(attained), accuracy, repeatability, squares))
    return tuple(found)
