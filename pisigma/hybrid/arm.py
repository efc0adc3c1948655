"""The geometric and the hybrid arm as one: the hybrid where joints were measured, the geometric one beyond."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.hybrid.coverage import JointCoverage
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot.description import Robot
from pisigma.se3 import rotation_from_vector, rotation_vector


@dataclass(frozen=True, eq=False)
class HybridArm:
    """`T(q) = base · Π A_i(q_i + Δ_i(q)) · tool` with the geometry and Δ that were fitted together.

    Beyond the joint values that were measured it goes over into the arm of the geometric calibration.

    Attributes:
        geometric: the arm of the geometric calibration.
        hybrid: the arm whose geometry goes with the correction.
        correction: Δ.
        coverage: the joint values that were measured.
        approach: `(dof,)`: +1 or -1 for the side from which every joint comes, 0 where that is not stated; None for all
            of them.
    """

    geometric: Robot
    hybrid: Robot
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
        return blend(
            forward_kinematics(self.geometric, q),
            forward_kinematics(self.hybrid, q + delta),
            self.coverage.share(q),
        )


def blend(
    T_from: Float[Tensor, "*batch 4 4"], T_to: Float[Tensor, "*batch 4 4"], share: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4 4"]:
    """Poses between two that lie near each other: positions on the straight line, rotations on the shortest arc.

    Args:
        T_from: at share 0.
        T_to: at share 1.
        share: between.
    """
    T = T_to.clone()
    way = share[..., None]
    T[..., :3, 3] = T_from[..., :3, 3] + way * (T_to[..., :3, 3] - T_from[..., :3, 3])
    turn = rotation_vector(T_from[..., :3, :3].mT @ T_to[..., :3, :3])
    turned = T_from[..., :3, :3] @ rotation_from_vector(way * turn)
    T[..., :3, :3] = torch.where((share == 1)[..., None, None], T_to[..., :3, :3], turned)
    return T
