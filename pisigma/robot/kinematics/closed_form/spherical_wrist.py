"""Closed form of six-joint arms with a spherical wrist: the last three axes intersect in a point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, no_type_check

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.canonical import canonical_rows
from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.robot.kinematics.closed_form.two_link import (
    ARM_BRANCHES,
    first_joint,
    rounding_tolerance,
    singular_tolerance,
    solve_first_joint,
    solve_two_link,
    two_link,
)
from pisigma.robot.kinematics.components import Columns, Frame, Scalar, as_tensors
from pisigma.robot.kinematics.tolerances import NEAREST_MARGIN

_RIGHT = math.pi / 2
_TWISTS = (-_RIGHT, 0.0, -_RIGHT, _RIGHT, -_RIGHT)


@no_type_check
def _spherical_joints(form: Any, P: Any, t: Any, only: int, branch: int, rounding: float, q: Any) -> None:
    """Solve joints 4 to 6 for t = joints 1 to 3, both flips, by `M = R_03^T · R = RotZ(t_4) RotY(-t_5) RotZ(t_6)`."""
    t_1, t_2, t_3 = t
    c_1, s_1 = math.cos(t_1), math.sin(t_1)
    c, s = math.cos(t_2 + t_3), math.sin(t_2 + t_3)
    xx, xy, xz = c_1 * c, s_1 * c, -s
    zx, zy, zz = -c_1 * s, -s_1 * s, -c
    m_02 = xx * P[0, 2] + xy * P[1, 2] + xz * P[2, 2]
    m_12 = s_1 * P[0, 2] - c_1 * P[1, 2]
    m_22 = zx * P[0, 2] + zy * P[1, 2] + zz * P[2, 2]
    m_00 = xx * P[0, 0] + xy * P[1, 0] + xz * P[2, 0]
    m_01 = xx * P[0, 1] + xy * P[1, 1] + xz * P[2, 1]
    m_10, m_11 = s_1 * P[0, 0] - c_1 * P[1, 0], s_1 * P[0, 1] - c_1 * P[1, 1]
    sine = math.hypot(m_02, m_12)
    # A straight wrist leaves joint 4 free: its joint value is then 0 on the `no_flip` branch.
    t_4 = form.sign[3] * form.offset[3] if sine <= rounding else math.atan2(-m_12, -m_02)
    t_5 = math.atan2(sine, m_22)
    cos, sin = math.cos(t_4), math.sin(t_4)
    # The row of RotZ(-t_4) · M without t_5 is (s_6, c_6, 0): exact for a straight wrist too.
    t_6 = math.atan2(cos * m_10 - sin * m_00, cos * m_11 - sin * m_01)
    for flip in range(2):
        if only < 0 or only == branch + flip:
            out, turn = q[branch + flip], math.pi * flip
            out[0], out[1], out[2] = t_1, t_2, t_3
            out[3], out[4], out[5] = t_4 + turn, t_5 * (1.0 - 2 * flip), t_6 + turn


@no_type_check
def spherical_wrist_branches(form: Any, P: Any, only: int, rounding: float, q: Any) -> None:
    """Compute all eight branches of an arm with a spherical wrist; see `AbstractClosedForm.compiled`."""
    a, d, nearest = form.a, form.d, only < -1
    margin = NEAREST_MARGIN if nearest else 0.0
    # The second link is the diagonal from axis 3 to the wrist centre, at (a_3, d_4) in the axes of row 3.
    forearm, side = math.hypot(a[2], d[3]), d[1] + d[2]
    scale = abs(a[0]) + abs(a[1]) + forearm + abs(side)
    far, azimuth, reachable, on_axis = first_joint(
        P, side, scale, form.sign[0] * form.offset[0], rounding, margin
    )
    if not reachable and not nearest:
        return
    for pair in range(4):
        if only >= 0 and only // 2 != pair:
            continue
        shoulder, elbow = 1.0 - 2 * (pair // 2), 1.0 - 2 * (pair % 2)
        ahead = shoulder * far
        t_1 = azimuth - math.atan2(side, ahead)
        # On axis 1, atan2 of two rounding errors is arbitrary; the back branch is half a turn from the azimuth.
        if shoulder < 0 and on_axis:
            t_1 = azimuth - math.pi
        # Because of the twist of -90 deg, y of the plane points downwards: a positive elbow angle puts the elbow
        # above the line. The back branch and a negative first link each reverse this.
        upwards = shoulder * elbow * math.copysign(1.0, a[1])
        zero = form.sign[1] * form.offset[1]
        t_2, bend, reached = two_link(
            ahead - a[0], d[0] - P[2, 3], a[1], forearm, upwards, zero, rounding, margin
        )
        if reached or nearest:
            _spherical_joints(form, P, (t_1, t_2, bend - math.atan2(d[3], a[2])), only, 2 * pair, rounding, q)


@dataclass(frozen=True, eq=False)
class SphericalWristArm(AbstractClosedForm):
    """Anthropomorphic arm with twists -90, 0, -90, 90, -90 deg (each modulo 180 deg) and a spherical wrist.

    Appendix B of Jeong et al. 1998 is the case `a_1 = a_3 = d_1 = d_6 = 0`. The wrist centre determines the first
    three joints (Pieper 1968), the remaining rotation the last three. Lengths a_1, a_2, a_3, d_1, d_2, d_3, d_4, a_6,
    d_6, offsets, directions, base and tool are arbitrary.

    Branches are named `shoulder/elbow/wrist`:

    - `front` or `back`: the wrist centre is ahead of or behind axis 1 in the plane of the arm.
    - `elbow_up` or `elbow_down`: the elbow is on the side of the line from shoulder to wrist centre to which the first
      axis points, or on the other side, if the wrist centre is farther out than the shoulder.
    - `no_flip` or `flip`: the wrist angle `t_5`, about the canonical axis, is positive or negative.

    A pose is SINGULAR if the elbow is stretched or folded (two branches meet), if the wrist centre is on axis 1 (joint
    1 is not determined and set to 0 on the front branches), or if the wrist is straight (axes 4 and 6 coincide; joint 4
    is set to 0 on the `no_flip` branches). Near a singularity, but not at it, the exact values are returned.
    """

    name = "spherical_wrist"
    branches = ARM_BRANCHES
    compiled = staticmethod(spherical_wrist_branches)

    @classmethod
    def from_robot(cls, robot: Robot) -> "SphericalWristArm | None":
        """Return the solver, or None if the rows are not those of such an arm or a link has no length."""
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
        """Solve joints 1 to 3, which bring the wrist centre to p."""
        (a_1, a_2, a_3, *_), (d_1, d_2, d_3, d_4, *_) = self.rows.a, self.rows.d
        scale = abs(a_1) + abs(a_2) + math.hypot(a_3, d_4) + abs(d_2 + d_3)
        x, y, z = p
        zero = self.rows.variable_at_zero(0)
        t_1, ahead, beside_axis = solve_first_joint(x, y, d_2 + d_3, scale, shoulder, zero, self.margin)
        # The second link is the diagonal (a_3, d_4); the plane's y axis points downwards, hence d_1 - z.
        arm = solve_two_link(
            ahead - a_1,
            d_1 - z,
            a_2,
            math.hypot(a_3, d_4),
            math.copysign(1.0, a_2) * shoulder * elbow,
            self.rows.variable_at_zero(1),
            self.margin,
        )
        singular = arm.singular | (ahead.abs() < singular_tolerance(x.dtype) * scale)
        return [t_1, arm.first, arm.elbow - math.atan2(d_4, a_3)], arm.reached & beside_axis, singular

    def _solve_wrist(self, R: Columns, t_123: Sequence[Tensor], wrist: Scalar) -> tuple[list[Tensor], Tensor]:
        """Solve joints 4 to 6 by `M = R_03ᵀ · R = RotZ(t_4) RotY(-t_5) RotZ(t_6)`; `t_5` is negative if flipped.

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
        # A straight wrist leaves joint 4 free: its joint value is then 0 on the `no_flip` branch.
        t_4 = torch.where(sine <= rounding_tolerance(sine.dtype), self.rows.variable_at_zero(3), t_4)
        cos, sin = torch.cos(t_4), torch.sin(t_4)
        # The row of RotZ(-t_4) · M without t_5 is (s_6, c_6, 0): exact for a straight wrist too.
        t_6 = torch.atan2(cos * m_1[0] - sin * m_0[0], cos * m_1[1] - sin * m_0[1])
        flip = math.pi / 2 * (1 - wrist)
        return [t_4 + flip, wrist * torch.atan2(sine, m_22), t_6 + flip], sine < singular_tolerance(
            sine.dtype
        )
