"""The calibrated arm with its joint correction, and which of its joints' values were measured."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.joint_correction.feature import turning_rate
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.tolerances import MEASURED_ROUNDING

LARGEST_GAP = math.radians(60)
"""Joint values between two measured ones that are not farther apart than this count as measured."""


@dataclass(frozen=True, eq=False)
class JointCoverage:
    """Stretches of every joint's values that were measured, as angles (see `turning_rate`).

    Attributes:
        joint: number of the joint of every stretch.
        middle: of the stretch [rad].
        half: half its length [rad].
        rate: per joint, angle per joint value.
        turning: per joint, whether values a full turn apart are the same.
    """

    joint: Int64[Tensor, " stretches"]
    middle: Float64[Tensor, " stretches"]
    half: Float64[Tensor, " stretches"]
    rate: Float64[Tensor, " dof"]
    turning: tuple[bool, ...]

    @staticmethod
    def of(robot: Robot, q: Float64[Tensor, "rows dof"]) -> "JointCoverage":
        """Stretches around measured joint values."""
        rate = torch.from_numpy(turning_rate(robot))
        turning = tuple(bool(turns) for turns in robot.revolute)
        return JointCoverage._around(list((q.cpu() * rate).t()), rate, turning)

    @staticmethod
    def _around(angles: list[Tensor], rate: Tensor, turning: tuple[bool, ...]) -> "JointCoverage":
        stretches = [_stretches(of_joint.numpy(), turning[j]) for j, of_joint in enumerate(angles)]
        joint = torch.arange(len(turning)).repeat_interleave(torch.tensor([len(ends) for ends in stretches]))
        ends = torch.tensor([pair for pairs in stretches for pair in pairs], dtype=torch.float64)
        return JointCoverage(joint, ends.mean(1), (ends[:, 1] - ends[:, 0]) / 2, rate, turning)

    def with_rows(self, q: Float64[Tensor, "rows dof"]) -> "JointCoverage":
        """Stretches around these and more measured joint values."""
        angles = []
        for j in range(len(self.turning)):
            of_joint = [(q[:, j] * self.rate[j]).cpu()]
            for middle, half in zip(self.middle[self.joint == j], self.half[self.joint == j], strict=True):
                steps = 2 + int(2 * float(half) / LARGEST_GAP)
                of_joint.append(middle + half * torch.linspace(-1, 1, steps, dtype=torch.float64))
            angles.append(torch.cat(of_joint))
        return JointCoverage._around(angles, self.rate, self.turning)

    def beyond(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Angle from every joint value to the nearest measured stretch [rad], 0 within one."""
        angle = q * self.rate.to(q)
        columns = []
        for j, turns in enumerate(self.turning):
            here = self.joint == j
            off = angle[..., j, None] - self.middle[here].to(q)
            if turns:
                off = off - 2 * math.pi * torch.round(off / (2 * math.pi))
            columns.append((off.abs() - self.half[here].to(q)).clamp(min=0).amin(-1))
        return torch.stack(columns, -1)

    def contains(self, q: Float[Tensor, "*batch dof"]) -> Bool[Tensor, "*batch"]:
        """Whether all values of the joints were measured, up to rounding; a NaN never was."""
        return self.beyond(q).amax(-1) <= MEASURED_ROUNDING


def _stretches(angles: np.ndarray, turns: bool) -> list[tuple[float, float]]:
    """Lowest and highest angle of every stretch without a large gap; one may reach over the full turn."""
    values = np.unique(np.mod(angles, 2 * np.pi) if turns else angles)
    breaks = np.flatnonzero(np.diff(values) > LARGEST_GAP)
    lows = values[np.concatenate([[0], breaks + 1])]
    highs = values[np.concatenate([breaks, [len(values) - 1]])]
    if turns and values[0] + 2 * np.pi - values[-1] <= LARGEST_GAP:
        if len(lows) == 1:
            return [(0.0, 2 * np.pi)]
        lows, highs = lows[1:], np.concatenate([highs[1:-1], [highs[0] + 2 * np.pi]])
    return [(float(low), float(high)) for low, high in zip(lows, highs, strict=True)]


@dataclass(frozen=True, eq=False)
class HybridArm:
    """`T(q) = base · Π A_i(q_i + Δ_i(q)) · tool` with the geometry and Δ that were fitted together.

    It holds at all joint values. Beyond those that were measured it is an extrapolation, of which the uncertainty of
    the fit says how good it is; see `PositionUncertainty`.

    Attributes:
        robot: the geometry that goes with the correction.
        correction: Δ.
        coverage: the joint values that were measured.
        approach: `(dof,)`: +1 or -1 for the side from which every joint comes, 0 where that is not stated; None for all
            of them.
    """

    robot: Robot
    correction: JointCorrection
    coverage: JointCoverage
    approach: Float[Tensor, " dof"] | None = None

    def delta(self, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Δ [rad or m] at commanded joint values q [rad or m], coming from the sides of `approach`."""
        sides = None if self.approach is None else self.approach.to(q).expand_as(q)
        delta: Tensor = self.correction(q, sides)
        return delta

    def forward(
        self, q: Float[Tensor, "*batch dof"], approach: Float[Tensor, "*batch dof"] | None = None
    ) -> Float[Tensor, "*batch 4 4"]:
        """Pose T_base_tool at commanded joint values.

        Args:
            q: joint values [rad or m].
            approach: see `JointCorrection.forward`; None for that of the arm.
        """
        with torch.no_grad():
            delta = self.delta(q) if approach is None else self.correction(q, approach)
        return forward_kinematics(self.robot, q + delta)
