"""Closed form of six-joint arms whose last three axes meet in a point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.kinematics.closed_form.canonical import canonical_rows
from pisigma.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.kinematics.closed_form.two_link import ARM_BRANCHES, rounding, singular_tolerance, solve_two_link
from pisigma.kinematics.components import Columns, Frame, Scalar, as_tensors
from pisigma.robot.description import Robot

_RIGHT = math.pi / 2
_TWISTS = (-_RIGHT, 0.0, -_RIGHT, _RIGHT, -_RIGHT)


@dataclass(frozen=True, eq=False)
class SphericalWristArm(AbstractClosedForm):
    """Anthropomorphic arm with twists -90, 0, -90, 90, -90 deg (each up to 180 deg) and a spherical wrist.

    Appendix B of Jeong et al. 1998 is the case `a_1 = a_3 = d_1 = d_6 = 0`. The wrist centre gives the first
    three joints (Pieper 1968), the rotation that is left the last three. Lengths a_1, a_2, a_3, d_1, d_2,
    d_3, d_4, a_6, d_6, offsets, directions, base and tool are free.

    Branches are named `shoulder/elbow/wrist`:

    - `front` or `back`: the wrist centre lies ahead of or behind axis 1, as seen in the plane of the arm.
    - `elbow_up` or `elbow_down`: the elbow lies on the side of the line from shoulder to wrist centre where
      the first axis points, or on the other, for a wrist centre that lies outwards from the shoulder.
    - `no_flip` or `flip`: the bend `t_5` of the wrist, counted about the canonical axis, is positive or
      negative.

    SINGULAR: the elbow is stretched or folded (two branches meet), the wrist centre is on axis 1 (joint 1 is
    not determined and given as 0 on the front branches), or the wrist is straight (joints 4 and 6 turn about
    one axis; joint 4 is given as 0 on the `no_flip` branches). Near, but not at, such a place the exact
    values are given.
    """

    branches = ARM_BRANCHES
    compiled = "spherical_wrist"

    @classmethod
    def of(cls, robot: Robot) -> "SphericalWristArm | None":
        """The solver, or None where the rows are no such arm or a link has no length."""
        rows = canonical_rows(robot, ("revolute",) * 6, _TWISTS)
        if (
            rows is None
            or rows.a[3]
            or rows.a[4]
            or rows.d[4]
            or not rows.a[1]
            or not (rows.a[2] or rows.d[3])
        ):
            return None
        return cls(robot, rows)

    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        shoulder, elbow, wrist = signs
        columns = as_tensors(T)
        t_123, reached, arm_singular = self._solve_arm(columns[3], shoulder, elbow)
        t_456, wrist_singular = self._solve_wrist(columns, t_123, wrist)
        return [*t_123, *t_456], reached, arm_singular | wrist_singular

    def _solve_arm(
        self, p: tuple[Tensor, Tensor, Tensor], shoulder: Scalar, elbow: Scalar
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Joints 1 to 3 that bring the wrist centre to p."""
        (a_1, a_2, a_3, *_), (d_1, d_2, d_3, d_4, *_) = self.rows.a, self.rows.d
        scale = abs(a_1) + abs(a_2) + math.hypot(a_3, d_4) + abs(d_2 + d_3)
        x, y, z = p
        side = d_2 + d_3
        square = x * x + y * y - side * side
        beside_axis = square >= -rounding(x.dtype) * scale * scale
        ahead = shoulder * square.clamp(min=0).sqrt()
        on_axis = torch.hypot(x, y) <= rounding(x.dtype) * scale
        azimuth = torch.where(on_axis, self.rows.variable_at_zero(0), torch.atan2(y, x))
        t_1 = azimuth - torch.atan2(torch.full_like(ahead, side), ahead)
        t_1 = torch.where(on_axis & ahead.signbit(), azimuth - math.pi, t_1)
        arm = solve_two_link(
            ahead - a_1,
            d_1 - z,
            a_2,
            math.hypot(a_3, d_4),
            math.copysign(1.0, a_2) * shoulder * elbow,
            self.rows.variable_at_zero(1),
        )
        singular = arm.singular | (ahead.abs() < singular_tolerance(x.dtype) * scale)
        return [t_1, arm.first, arm.elbow - math.atan2(d_4, a_3)], arm.reached & beside_axis, singular

    def _solve_wrist(self, R: Columns, t_123: Sequence[Tensor], wrist: Scalar) -> tuple[list[Tensor], Tensor]:
        """Joints 4 to 6 from `M = R_03ᵀ · R = RotZ(t_4) RotY(-t_5) RotZ(t_6)`; flipped, `t_5` is negative.

        `R_03 = RotZ(t_1) RotX(-90 deg) RotZ(t_2 + t_3) RotX(-90 deg)`.
        """
        c_1, s_1 = torch.cos(t_123[0]), torch.sin(t_123[0])
        c_23, s_23 = torch.cos(t_123[1] + t_123[2]), torch.sin(t_123[1] + t_123[2])
        along = [c_1 * column[0] + s_1 * column[1] for column in R]
        m_0 = [c_23 * ahead - s_23 * column[2] for ahead, column in zip(along, R, strict=True)]
        m_1 = [s_1 * column[0] - c_1 * column[1] for column in R]
        m_22 = -s_23 * along[2] - c_23 * R[2][2]
        sine = torch.hypot(m_0[2], m_1[2])
        t_4 = torch.atan2(-m_1[2], -m_0[2])
        t_4 = torch.where(sine <= rounding(sine.dtype), self.rows.variable_at_zero(3), t_4)
        cos, sin = torch.cos(t_4), torch.sin(t_4)
        t_6 = torch.atan2(cos * m_1[0] - sin * m_0[0], cos * m_1[1] - sin * m_0[1])
        flip = math.pi / 2 * (1 - wrist)
        return [t_4 + flip, wrist * torch.atan2(sine, m_22), t_6 + flip], sine < singular_tolerance(
            sine.dtype
        )
