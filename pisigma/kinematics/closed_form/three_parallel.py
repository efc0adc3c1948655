"""Closed form of six-joint arms whose axes 2, 3 and 4 are parallel: the usual collaborative robots."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from pisigma.kinematics.closed_form.canonical import canonical_rows
from pisigma.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.kinematics.closed_form.two_link import (
    ARM_BRANCHES,
    TwoLink,
    rounding,
    singular_tolerance,
    solve_two_link,
)
from pisigma.kinematics.components import Columns, Frame, Scalar, as_tensors
from pisigma.kinematics.tolerances import TRIANGLE_MARGIN
from pisigma.robot.description import Robot

_RIGHT = math.pi / 2
_TWISTS = (_RIGHT, 0.0, 0.0, _RIGHT, -_RIGHT)


@dataclass(frozen=True, eq=False)
class ThreeParallelArm(AbstractClosedForm):
    """Arm with twists 90, 0, 0, 90, -90 deg (each up to 180 deg) whose axes 5 and 6 meet: UR, RB and the like.

    Axis 2 is a normal of the plane in which joints 2 to 4 move. The height over it of the point where axes 5
    and 6 meet gives joint 1, its direction in the wanted frame gives joints 5 and 6; what is left are two
    links in the plane (Hawkins 2013, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms",
    here for any a_1 to a_4, d_1 to d_6, a_6, offsets, directions, base and tool).

    Branches are named `shoulder/elbow/wrist`:

    - `front` or `back`: the point where axes 5 and 6 meet lies ahead of or behind axis 1, as seen in the plane
      of the arm.
    - `elbow_up` or `elbow_down`: the elbow lies on the side of the line from axis 2 to axis 4 where the first
      axis points, or on the other, for an axis 4 that lies outwards from axis 2.
    - `no_flip` or `flip`: `t_5`, counted about the canonical axis, is positive or negative.

    SINGULAR: the elbow is stretched or folded (two branches meet), the point where axes 5 and 6 meet lies in
    the plane of axis 1 that is parallel to axis 2 (front and back meet; on axis 1 itself joint 1 is not
    determined and given as 0 on the front branches), or the wrist is straight (axes 4 and 6 are parallel).
    There joint 6 is given as 0 where the elbow reaches so, else as what brings the elbow just within reach.
    Near, but not at, such a place the exact values are given.
    """

    branches = ARM_BRANCHES
    compiled = "three_parallel"

    @classmethod
    def of(cls, robot: Robot) -> "ThreeParallelArm | None":
        """The solver, or None where the rows are no such arm or a link has no length."""
        rows = canonical_rows(robot, ("revolute",) * 6, _TWISTS)
        if rows is None or rows.a[4] or not rows.a[1] or not rows.a[2]:
            return None
        return cls(robot, rows)

    @property
    def _scale(self) -> float:
        """How long the arm is [m]: what lengths are compared with."""
        a, d = self.rows.a, self.rows.d
        return abs(a[0]) + abs(a[1]) + abs(a[2]) + math.hypot(a[3], d[4]) + abs(d[1] + d[2] + d[3])

    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        shoulder, elbow, wrist = signs
        columns = as_tensors(T)
        p = columns[3]
        t_1, ahead, beside = self._solve_first(p[0], p[1], shoulder)
        t_5, t_6, straight = self._solve_wrist(columns, t_1, wrist)
        x, y = ahead - self.rows.a[0], p[2] - self.rows.d[0]
        upwards = -math.copysign(1.0, self.rows.a[1]) * shoulder * elbow
        arm, t_234 = self._solve_plane(columns, t_1, t_6, x, y, upwards)
        free = (straight <= rounding(x.dtype)) & ~arm.reached
        if free.any():
            t_6 = torch.where(free, self._turned_wrist(t_234, t_5, t_6, x, y), t_6)
            arm, t_234 = self._solve_plane(columns, t_1, t_6, x, y, upwards)
        t_3 = arm.elbow - (math.pi if self.rows.a[2] < 0 else 0.0)
        tolerance = singular_tolerance(x.dtype)
        singular = arm.singular | (ahead.abs() < tolerance * self._scale) | (straight < tolerance)
        return [t_1, arm.first, t_3, t_234 - arm.first - t_3, t_5, t_6], arm.reached & beside, singular

    def _solve_first(self, x: Tensor, y: Tensor, shoulder: Scalar) -> tuple[Tensor, Tensor, Tensor]:
        """Joint 1 from `s_1 x - c_1 y = d_2 + d_3 + d_4`; `c_1 x + s_1 y`; and whether there is such a joint."""
        side = sum(self.rows.d[1:4])
        square = x * x + y * y - side * side
        beside = square >= -rounding(x.dtype) * self._scale**2
        ahead = shoulder * square.clamp(min=0).sqrt()
        on_axis = torch.hypot(x, y) <= rounding(x.dtype) * self._scale
        azimuth = torch.where(on_axis, self.rows.variable_at_zero(0), torch.atan2(y, x))
        t_1 = azimuth + torch.atan2(torch.full_like(ahead, side), ahead)
        return torch.where(on_axis & (ahead.signbit()), azimuth + math.pi, t_1), ahead, beside

    def _solve_wrist(self, R: Columns, t_1: Tensor, wrist: Scalar) -> tuple[Tensor, Tensor, Tensor]:
        """Joints 5 and 6, and the size of `s_5`: axis 2 in the wanted frame is `(s_5 c_6, -s_5 s_6, c_5)`."""
        cos, sin = torch.cos(t_1), torch.sin(t_1)
        x, y, z = (sin * R[j][0] - cos * R[j][1] for j in range(3))
        sine = torch.hypot(x, y)
        t_6 = torch.where(
            sine <= rounding(x.dtype), self.rows.variable_at_zero(5), torch.atan2(-wrist * y, wrist * x)
        )
        return wrist * torch.atan2(sine, z), t_6, sine

    def _solve_plane(
        self, R: Columns, t_1: Tensor, t_6: Tensor, x: Tensor, y: Tensor, upwards: Scalar
    ) -> tuple[TwoLink, Tensor]:
        """The two links that carry axis 4, and `t_2 + t_3 + t_4`, from axis 5 `(s_234, -c_234)` in the plane."""
        cos, sin = torch.cos(t_6), torch.sin(t_6)
        axis = [-sin * R[0][i] - cos * R[1][i] for i in range(3)]
        t_234 = torch.atan2(torch.cos(t_1) * axis[0] + torch.sin(t_1) * axis[1], -axis[2])
        cos, sin = torch.cos(t_234), torch.sin(t_234)
        along, across = self.rows.a[3], -self.rows.d[4]
        arm = solve_two_link(
            x - (cos * along - sin * across),
            y - (sin * along + cos * across),
            self.rows.a[1],
            abs(self.rows.a[2]),
            upwards,
            self.rows.variable_at_zero(1),
        )
        return arm, t_234

    def _turned_wrist(self, t_234: Tensor, t_5: Tensor, t_6: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Joint 6 of a straight wrist that brings axis 4 just within the elbow's reach, on the side it was."""
        along, across = self.rows.a[3], -self.rows.d[4]
        hand, far = math.hypot(along, across), torch.hypot(x, y)
        if hand == 0.0:
            return t_6
        a, b = abs(self.rows.a[1]), abs(self.rows.a[2])
        turn = t_234 + math.atan2(across, along) - torch.atan2(y, x)
        square = far * far + hand * hand - 2 * far * hand * torch.cos(turn)
        nearest, farthest = abs(a - b) + TRIANGLE_MARGIN * (a + b), (a + b) * (1 - TRIANGLE_MARGIN)
        wanted = square.clamp(nearest**2, farthest**2)
        safe = torch.where(far > 0, far, torch.ones_like(far))
        cosine = ((far * far + hand * hand - wanted) / (2 * safe * hand)).clamp(-1, 1)
        change = torch.copysign(torch.acos(cosine), torch.sin(turn)) - turn
        return t_6 - torch.sign(torch.cos(t_5)) * change
