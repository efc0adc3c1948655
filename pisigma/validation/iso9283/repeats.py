"""Pose accuracy and repeatability of the poses that were measured more than once, as in rows of a session."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, numbers_of_names
from pisigma.validation.iso9283.pose import position_accuracy, position_repeatability

CYCLES = 30
"""Number of repeats of a pose that ISO 9283:1998 asks for."""


@dataclass(frozen=True)
class RepeatedPose:
    """ISO 9283 figures of a pose that was measured more than once.

    Attributes:
        rows: number of measurements of the pose.
        accuracy: pose accuracy AP_P [m]: distance from the commanded position, which the model predicts, to the
            barycentre of the measured ones; None if the frame of the rows is not one of the model.
        repeatability: pose repeatability RP_l [m].
    """

    rows: int
    accuracy: float | None
    repeatability: float

    def to_json(self) -> dict[str, Any]:
        """Return plain values, lengths in mm."""
        accuracy = None if self.accuracy is None else self.accuracy * 1e3
        return {"rows": self.rows, "ap_mm": accuracy, "rp_mm": self.repeatability * 1e3}


def repeated_poses(
    rows: Measurements, commanded: Float64[Tensor, "rows 3"] | None
) -> tuple[RepeatedPose, ...]:
    """Compute AP_P and RP_l of every pose with two or more measured positions.

    Args:
        rows: measured rows; rows of one pose have equal joint values, frames and targets.
        commanded: commanded position of every row, in the frame of the row [m]; None if it is not known.
    """
    if rows.position is None:
        return ()
    joints = groups_of_equal_joints(rows.q).tolist()
    pose = numbers_of_names(list(zip(joints, rows.frame, rows.target, strict=True)))
    found = []
    for number in range(int(pose.max()) + 1):
        of_pose = (pose == number) & torch.isfinite(rows.position).all(-1)
        attained = rows.position[of_pose]
        if len(attained) > 1:
            accuracy = None
            if commanded is not None:
                accuracy = float(position_accuracy(attained, commanded[of_pose][0]).length)
            found.append(RepeatedPose(len(attained), accuracy, float(position_repeatability(attained))))
    return tuple(found)
