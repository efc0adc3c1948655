"""Calibrated arm with a joint correction, and the measured ranges of its joint values."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.joint_correction.feature import angle_per_joint_value
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.tolerances import MEASURED_ROUNDING

_LARGEST_GAP = math.radians(60)
"""Largest distance between two measured joint values [rad] at which all values in between are treated as measured."""


@dataclass(frozen=True, eq=False)
class JointCoverage:
    """Measured ranges of every joint's values, as angles (see `angle_per_joint_value`).

    Attributes:
        joint: index of the joint of every range.
        middle: middle of every range [rad].
        half_width: half the length of every range [rad].
        angle_per_value: angle per joint value, per joint [rad/rad or rad/m].
        is_periodic: whether values of a joint that differ by 2π are equivalent, per joint.
    """

    joint: Int64[Tensor, " stretches"]
    middle: Float64[Tensor, " stretches"]
    half_width: Float64[Tensor, " stretches"]
    angle_per_value: Float64[Tensor, " dof"]
    is_periodic: tuple[bool, ...]

    @staticmethod
    def from_joints(robot: Robot, q: Float64[Tensor, "rows dof"]) -> "JointCoverage":
        """Return the ranges that are covered by measured joint values."""
        rate = torch.from_numpy(angle_per_joint_value(robot))
        turning = tuple(bool(turns) for turns in robot.revolute)
        return JointCoverage._around(list((q.cpu() * rate).t()), rate, turning)

    @staticmethod
    def _around(angles: list[Tensor], rate: Tensor, turning: tuple[bool, ...]) -> "JointCoverage":
        stretches = [_stretches(of_joint.numpy(), turning[j]) for j, of_joint in enumerate(angles)]
        joint = torch.arange(len(turning)).repeat_interleave(torch.tensor([len(ends) for ends in stretches]))
        ends = torch.tensor([pair for pairs in stretches for pair in pairs], dtype=torch.float64)
        return JointCoverage(joint, ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2, rate, turning)

    def with_rows(self, q: Float64[Tensor, "rows dof"]) -> "JointCoverage":
        """Return the ranges that are covered by these and further measured joint values."""
        angles = []
        for j in range(len(self.is_periodic)):
            of_joint = [(q[:, j] * self.angle_per_value[j]).cpu()]
            for middle, half in zip(
                self.middle[self.joint == j], self.half_width[self.joint == j], strict=True
            ):
                steps = 2 + int(2 * float(half) / _LARGEST_GAP)
                of_joint.append(middle + half * torch.linspace(-1, 1, steps, dtype=torch.float64))
            angles.append(torch.cat(of_joint))
        return JointCoverage._around(angles, self.angle_per_value, self.is_periodic)

    def distance_outside(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Compute the angle from every joint value to the nearest measured range [rad]; 0 within one."""
        angle = q * self.angle_per_value.to(q)
        columns = []
        for j, turns in enumerate(self.is_periodic):
            here = self.joint == j
            off = angle[..., j, None] - self.middle[here].to(q)
            if turns:
                off = off - 2 * math.pi * torch.round(off / (2 * math.pi))
            columns.append((off.abs() - self.half_width[here].to(q)).clamp(min=0).amin(-1))
        return torch.stack(columns, -1)

    def contains(self, q: Float[Tensor, "*batch dof"]) -> Bool[Tensor, "*batch"]:
        """Return whether all joint values are in measured ranges, up to rounding; False for NaN."""
        return self.distance_outside(q).amax(-1) <= MEASURED_ROUNDING


def _stretches(angles: np.ndarray, turns: bool) -> list[tuple[float, float]]:
    """Return the lowest and highest angle of every range without a large gap; a range may extend beyond 2π."""
    values = np.unique(np.mod(angles, 2 * np.pi) if turns else angles)
    breaks = np.flatnonzero(np.diff(values) > _LARGEST_GAP)
    lows = values[np.concatenate([[0], breaks + 1])]
    highs = values[np.concatenate([breaks, [len(values) - 1]])]
    if turns and values[0] + 2 * np.pi - values[-1] <= _LARGEST_GAP:
        if len(lows) == 1:
            return [(0.0, 2 * np.pi)]
        lows, highs = lows[1:], np.concatenate([highs[1:-1], [highs[0] + 2 * np.pi]])
    return [(float(low), float(high)) for low, high in zip(lows, highs, strict=True)]


@dataclass(frozen=True, eq=False)
class HybridArm:
    """`T(q) = base · Π A_i(q_i + Δ_i(q)) · tool` with the geometry and Δ that were fitted together.

    The arm is defined at all joint values. Outside the measured ranges its correction is an extrapolation, whose
    accuracy is given by the posterior; see `PositionUncertainty`.

    Attributes:
        robot: the robot with the geometry that was fitted together with the correction.
        correction: the joint correction Δ.
        coverage: the measured ranges of joint values.
        approach: direction of approach of every joint, +1 or -1, or 0 if it is not stated; None if no direction is
            stated.
    """

    robot: Robot
    correction: JointCorrection
    coverage: JointCoverage
    approach: Float[Tensor, " dof"] | None = None

    def joint_correction(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Compute Δ [rad or m] at commanded joint values [rad or m], with the directions of `approach`."""
        sides = None if self.approach is None else self.approach.to(q).expand_as(q)
        delta: Tensor = self.correction(q, sides)
        return delta

    def forward(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch 4 4"]:
        """Compute the pose T_base_tool at commanded joint values.

        Args:
            q: joint values [rad or m].
            approach: see `JointCorrection.forward`; None for the directions of the arm.
        """
        with torch.no_grad():
            delta = self.joint_correction(q) if approach is None else self.correction(q, approach)
        return forward_kinematics(self.robot, q + delta)
