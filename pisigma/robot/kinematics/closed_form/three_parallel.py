"""Closed form of six-joint arms whose axes 2, 3 and 4 are parallel, such as most collaborative robots."""

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
    TwoLink,
    first_joint,
    rounding_tolerance,
    singular_tolerance,
    solve_first_joint,
    solve_two_link,
    two_link,
)
from pisigma.robot.kinematics.components import Columns, Frame, Scalar, as_tensors
from pisigma.robot.kinematics.tolerances import NEAREST_MARGIN, TRIANGLE_MARGIN

_RIGHT = math.pi / 2
_TWISTS = (_RIGHT, 0.0, 0.0, _RIGHT, -_RIGHT)


@no_type_check
def _plane_joints(
    form: Any, P: Any, t: Any, x: float, upwards: float, free: bool, margin: float, rounding: float, q: Any
) -> None:
    """Solve joints 2 to 4 for t = joints 1, 5, 6: two links that carry axis 4; a straight wrist may help them."""
    t_1, t_5, t_6 = t
    a, y, zero = form.a, P[2, 3] - form.d[0], form.sign[1] * form.offset[1]
    along, across, b = a[3], -form.d[4], abs(a[2])
    # A straight wrist leaves joint 6 free: if axis 4 is out of reach, joint 6 turns until axis 4 is just within reach.
    for attempt in range(2):
        s_6, c_6 = math.sin(t_6), math.cos(t_6)
        # Axis 5 in the target pose, rotated back by joint 6, is (s_234, -c_234) in the plane of joints 2 to 4.
        u, v = -s_6 * P[0, 0] - c_6 * P[0, 1], -s_6 * P[1, 0] - c_6 * P[1, 1]
        t_234 = math.atan2(math.cos(t_1) * u + math.sin(t_1) * v, s_6 * P[2, 0] + c_6 * P[2, 1])
        c, s = math.cos(t_234), math.sin(t_234)
        x_4, y_4 = x - (c * along - s * across), y - (s * along + c * across)
        first, bend, reached = two_link(x_4, y_4, a[1], b, upwards, zero, rounding, margin)
        turned = attempt == 1 or not free or math.hypot(along, across) == 0.0
        if reached or (margin > 0.0 and turned):
            # `two_link` takes a positive length: a negative second link points the other way.
            t_3 = bend - (math.pi if a[2] < 0 else 0.0)
            q[0], q[1], q[2] = t_1, first, t_3
            q[3], q[4], q[5] = t_234 - first - t_3, t_5, t_6
            return
        if turned:
            return
        # Law of cosines: distance of axis 4 from axis 2, and the hand angle at which the elbow just reaches it.
        hand, far = math.hypot(along, across), math.hypot(x, y)
        turn = t_234 + math.atan2(across, along) - math.atan2(y, x)
        nearest, farthest = (
            abs(abs(a[1]) - b) + TRIANGLE_MARGIN * (abs(a[1]) + b),
            (abs(a[1]) + b) * (1 - TRIANGLE_MARGIN),
        )
        square = far * far + hand * hand - 2 * far * hand * math.cos(turn)
        square = min(max(square, nearest * nearest), farthest * farthest)
        cosine = (far * far + hand * hand - square) / (2 * (far if far > 0 else 1.0) * hand)
        # Axis 4 remains on its side of the line from axis 2 to the wrist, which is the smaller of both rotations.
        change = math.copysign(math.acos(min(max(cosine, -1.0), 1.0)), math.sin(turn)) - turn
        # The pose fixes t_234 + t_6 if axis 6 is parallel to axis 4 (t_5 = 0), and t_234 - t_6 if it is opposite (pi).
        t_6 -= math.copysign(1.0, math.cos(t_5)) * change


@no_type_check
def three_parallel_branches(form: Any, P: Any, only: int, rounding: float, q: Any) -> None:
    """Compute all eight branches of an arm with three parallel axes; see `AbstractClosedForm.compiled`."""
    a, d, margin = form.a, form.d, NEAREST_MARGIN if only < -1 else 0.0
    side = d[1] + d[2] + d[3]
    scale = abs(a[0]) + abs(a[1]) + abs(a[2]) + math.hypot(a[3], d[4]) + abs(side)
    far, azimuth, reachable, on_axis = first_joint(
        P, side, scale, form.sign[0] * form.offset[0], rounding, margin
    )
    if not reachable and margin == 0.0:
        return
    for shoulder in range(2):
        if only >= 0 and only // 4 != shoulder:
            continue
        ahead = far * (1.0 - 2 * shoulder)
        t_1 = azimuth + math.atan2(side, ahead)
        # On axis 1, atan2 of two rounding errors is arbitrary; the back branch is half a turn from the azimuth.
        if shoulder == 1 and on_axis:
            t_1 = azimuth + math.pi
        s_1, c_1 = math.sin(t_1), math.cos(t_1)
        # Axis 2, the normal of the plane, in the target frame: (s_5 c_6, -s_5 s_6, c_5) determines joints 5 and 6.
        u, v, w = s_1 * P[0, 0] - c_1 * P[1, 0], s_1 * P[0, 1] - c_1 * P[1, 1], s_1 * P[0, 2] - c_1 * P[1, 2]
        sine = math.hypot(u, v)
        for wrist in range(2):
            if only >= 0 and only % 2 != wrist:
                continue
            flip = 1.0 - 2 * wrist
            free = sine <= rounding
            t_6 = form.sign[5] * form.offset[5] if free else math.atan2(-flip * v, flip * u)
            t_5 = flip * math.atan2(sine, w)
            for elbow in range(2):
                branch = 4 * shoulder + 2 * elbow + wrist
                if only < 0 or only == branch:
                    # y of the plane points up: a positive elbow angle puts the elbow below the line outwards.
                    # The back branch and a negative first link each reverse this.
                    upwards = -(1.0 - 2 * shoulder) * (1.0 - 2 * elbow) * math.copysign(1.0, a[1])
                    ahead_of_2, out = ahead - a[0], q[branch]
                    _plane_joints(form, P, (t_1, t_5, t_6), ahead_of_2, upwards, free, margin, rounding, out)


@dataclass(frozen=True, eq=False)
class ThreeParallelArm(AbstractClosedForm):
    """Arm with twists 90, 0, 0, 90, -90 deg (each modulo 180 deg) whose axes 5 and 6 meet, such as UR and RB robots.

    Axis 2 is normal to the plane in which joints 2 to 4 move. The height of the intersection of axes 5 and 6 above this
    plane determines joint 1, the direction of axis 2 in the target frame determines joints 5 and 6; two links in the
    plane remain (Hawkins 2013, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10 arms", here for any a_1
    to a_4, d_1 to d_6, a_6, offsets, directions, base and tool).

    Branches are named `shoulder/elbow/wrist`:

    - `front` or `back`: the intersection of axes 5 and 6 is ahead of or behind axis 1 in the plane of the arm.
    - `elbow_up` or `elbow_down`: the elbow is on the side of the line from axis 2 to axis 4 to which the first axis
      points, or on the other side, if axis 4 is farther out than axis 2.
    - `no_flip` or `flip`: `t_5`, about the canonical axis, is positive or negative.

    A pose is SINGULAR if the elbow is stretched or folded (two branches meet), if the intersection of axes 5 and 6 is
    in the plane through axis 1 parallel to axis 2 (front and back meet; on axis 1 itself joint 1 is not determined and
    set to 0 on the front branches), or if the wrist is straight (axes 4 and 6 are parallel). For a straight wrist joint
    6 is set to 0 if the elbow then reaches the pose, otherwise to the value that brings the pose just within reach.
    Near a singularity, but not at it, the exact values are returned.
    """

    name = "three_parallel"
    branches = ARM_BRANCHES
    compiled = staticmethod(three_parallel_branches)

    @classmethod
    def from_robot(cls, robot: Robot) -> "ThreeParallelArm | None":
        """Return the solver, or None if the rows are not those of such an arm or a link has no length."""
        rows = canonical_rows(robot, ("revolute",) * 6, _TWISTS)
        if rows is None or rows.a[4] or not rows.a[1] or not rows.a[2]:
            return None
        return cls(robot, rows)

    @property
    def _scale(self) -> float:
        """Length of the arm [m], to which rounding errors are relative."""
        a, d = self.rows.a, self.rows.d
        return abs(a[0]) + abs(a[1]) + abs(a[2]) + math.hypot(a[3], d[4]) + abs(d[1] + d[2] + d[3])

    def _solve_components(
        self, T: Frame, signs: Sequence[Scalar]
    ) -> tuple[list[Scalar], Bool[Tensor, "..."], Bool[Tensor, "..."]]:
        shoulder, elbow, wrist = signs
        columns = as_tensors(T)
        p = columns[3]
        zero, side = self.rows.variable_at_zero(0), -sum(self.rows.d[1:4])
        t_1, ahead, reachable = solve_first_joint(p[0], p[1], side, self._scale, shoulder, zero, self.margin)
        t_5, t_6, straight = self._solve_wrist(columns, t_1, wrist)
        x, y = ahead - self.rows.a[0], p[2] - self.rows.d[0]
        # The plane's y axis points up; see `three_parallel_branches` for the sign.
        upwards = -math.copysign(1.0, self.rows.a[1]) * shoulder * elbow
        arm, t_234 = self._solve_plane(columns, t_1, t_6, x, y, upwards)
        free = (straight <= rounding_tolerance(x.dtype)) & ~arm.reached
        if free.any():
            t_6 = torch.where(free, self._turned_wrist(t_234, t_5, t_6, x, y), t_6)
            arm, t_234 = self._solve_plane(columns, t_1, t_6, x, y, upwards)
        # `solve_two_link` takes a positive length: a negative second link points the other way.
        t_3 = arm.elbow - (math.pi if self.rows.a[2] < 0 else 0.0)
        tolerance = singular_tolerance(x.dtype)
        singular = arm.singular | (ahead.abs() < tolerance * self._scale) | (straight < tolerance)
        return [t_1, arm.first, t_3, t_234 - arm.first - t_3, t_5, t_6], arm.reached & reachable, singular

    def _solve_wrist(self, R: Columns, t_1: Tensor, wrist: Scalar) -> tuple[Tensor, Tensor, Tensor]:
        """Solve joints 5 and 6, and |s_5|: axis 2 in the target frame is `(s_5 c_6, -s_5 s_6, c_5)`."""
        cos, sin = torch.cos(t_1), torch.sin(t_1)
        x, y, z = (sin * R[j][0] - cos * R[j][1] for j in range(3))
        sine = torch.hypot(x, y)
        t_6 = torch.where(
            sine <= rounding_tolerance(x.dtype),
            self.rows.variable_at_zero(5),
            torch.atan2(-wrist * y, wrist * x),
        )
        return wrist * torch.atan2(sine, z), t_6, sine

    def _solve_plane(
        self, R: Columns, t_1: Tensor, t_6: Tensor, x: Tensor, y: Tensor, upwards: Scalar
    ) -> tuple[TwoLink, Tensor]:
        """Solve the two links that carry axis 4, and `t_2 + t_3 + t_4` from axis 5, `(s_234, -c_234)` in the plane."""
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
            self.margin,
        )
        return arm, t_234

    def _turned_wrist(self, t_234: Tensor, t_5: Tensor, t_6: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Return joint 6 of a straight wrist that brings axis 4 just within reach of the elbow, on the same side."""
        along, across = self.rows.a[3], -self.rows.d[4]
        hand, far = math.hypot(along, across), torch.hypot(x, y)
        if hand == 0.0:
            return t_6
        a, b = abs(self.rows.a[1]), abs(self.rows.a[2])
        turn = t_234 + math.atan2(across, along) - torch.atan2(y, x)
        # Law of cosines: distance of axis 4 from axis 2, and the hand angle at which the elbow just reaches it.
        square = far * far + hand * hand - 2 * far * hand * torch.cos(turn)
        nearest, farthest = abs(a - b) + TRIANGLE_MARGIN * (a + b), (a + b) * (1 - TRIANGLE_MARGIN)
        wanted = square.clamp(nearest**2, farthest**2)
        safe = torch.where(far > 0, far, torch.ones_like(far))
        cosine = ((far * far + hand * hand - wanted) / (2 * safe * hand)).clamp(-1, 1)
        change = torch.copysign(torch.acos(cosine), torch.sin(turn)) - turn
        # The pose fixes t_234 + t_6 if axis 6 is parallel to axis 4 (t_5 = 0), and t_234 - t_6 if it is opposite (pi).
        return t_6 - torch.sign(torch.cos(t_5)) * change
