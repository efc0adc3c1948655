"""Closed form of six-joint arms whose last three axes meet in a point."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.kinematics.closed_form.canonical import canonical_rows
from pisigma.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.kinematics.closed_form.tolerance import rounding, singular_tolerance
from pisigma.kinematics.closed_form.two_link import solve_two_link
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

    @property
    def branches(self) -> tuple[str, ...]:
        """`front/elbow_up/no_flip`, `front/elbow_up/flip`, `front/elbow_down/no_flip` and so on, 8 in all."""
        return tuple(
            f"{shoulder}/elbow_{elbow}/{wrist}"
            for shoulder in ("front", "back")
            for elbow in ("up", "down")
            for wrist in ("no_flip", "flip")
        )

    def _solve_canonical(
        self, T: Float[Tensor, "*batch 4 4"]
    ) -> tuple[Float[Tensor, "*batch 8 6"], Bool[Tensor, "*batch 8"], Bool[Tensor, "*batch 8"]]:
        signs = T.new_tensor([[shoulder, elbow] for shoulder in (1.0, -1.0) for elbow in (1.0, -1.0)])
        t_123, reached, arm_singular = self._solve_arm(T[..., None, :3, 3], signs[:, 0], signs[:, 1])
        t_456, wrist_singular = self._solve_wrist(T[..., None, :3, :3], t_123)
        variables = torch.cat([t_123[..., None, :].expand(t_456.shape), t_456], -1)
        singular = (arm_singular | wrist_singular).repeat_interleave(2, -1)
        return variables.flatten(-3, -2), reached.repeat_interleave(2, -1), singular

    def _solve_arm(
        self, p: Float[Tensor, "*batch 1 3"], shoulder: Float[Tensor, " 4"], elbow: Float[Tensor, " 4"]
    ) -> tuple[Float[Tensor, "*batch 4 3"], Bool[Tensor, "*batch 4"], Bool[Tensor, "*batch 4"]]:
        """Joints 1 to 3 that bring the wrist centre to p."""
        (a_1, a_2, a_3, *_), (d_1, d_2, d_3, d_4, *_) = self.rows.a, self.rows.d
        scale = abs(a_1) + abs(a_2) + math.hypot(a_3, d_4) + abs(d_2 + d_3)
        x, y, z = p.expand(*p.shape[:-2], 4, 3).unbind(-1)
        side = d_2 + d_3
        square = x * x + y * y - side * side
        beside_axis = square >= -rounding(p.dtype) * scale * scale
        ahead = shoulder * square.clamp(min=0).sqrt()
        azimuth = torch.atan2(y, x)
        on_axis = torch.hypot(x, y) <= rounding(p.dtype) * scale
        azimuth = torch.where(on_axis, self.rows.variable_at_zero(0), azimuth)
        t_1 = azimuth - torch.atan2(torch.full_like(ahead, side), ahead)
        t_1 = torch.where((shoulder < 0) & on_axis, azimuth - math.pi, t_1)
        upwards = shoulder * elbow * math.copysign(1.0, a_2)
        arm = solve_two_link(
            ahead - a_1,
            d_1 - z,
            a_2,
            math.hypot(a_3, d_4),
            upwards.expand(x.shape),
            self.rows.variable_at_zero(1),
        )
        t_3 = arm.elbow - math.atan2(d_4, a_3)
        singular = arm.singular | (ahead.abs() < singular_tolerance(p.dtype) * scale)
        return torch.stack([t_1, arm.first, t_3], -1), arm.reached & beside_axis, singular

    def _solve_wrist(
        self, R: Float[Tensor, "*batch 1 3 3"], t_123: Float[Tensor, "*batch 4 3"]
    ) -> tuple[Float[Tensor, "*batch 4 2 3"], Bool[Tensor, "*batch 4"]]:
        """Joints 4 to 6, both flips, from `M = R_03^T · R = RotZ(t_4) RotY(-t_5) RotZ(t_6)`."""
        M = _rotation_of_arm(t_123).mT @ R
        sine = torch.hypot(M[..., 0, 2], M[..., 1, 2])
        t_4 = torch.atan2(-M[..., 1, 2], -M[..., 0, 2])
        t_4 = torch.where(sine <= rounding(R.dtype), self.rows.variable_at_zero(3), t_4)
        t_5 = torch.atan2(sine, M[..., 2, 2])
        cos, sin = torch.cos(t_4), torch.sin(t_4)
        t_6 = torch.atan2(cos * M[..., 1, 0] - sin * M[..., 0, 0], cos * M[..., 1, 1] - sin * M[..., 0, 1])
        no_flip = torch.stack([t_4, t_5, t_6], -1)
        flip = torch.stack([t_4 + math.pi, -t_5, t_6 + math.pi], -1)
        return torch.stack([no_flip, flip], -2), sine < singular_tolerance(R.dtype)


def _rotation_of_arm(t_123: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """`R_03 = RotZ(t_1) RotX(-90 deg) RotZ(t_2 + t_3) RotX(-90 deg)`."""
    t_23 = t_123[..., 1] + t_123[..., 2]
    c_1, s_1 = torch.cos(t_123[..., 0]), torch.sin(t_123[..., 0])
    c_23, s_23 = torch.cos(t_23), torch.sin(t_23)
    rows = [
        torch.stack([c_1 * c_23, s_1, -c_1 * s_23], -1),
        torch.stack([s_1 * c_23, -c_1, -s_1 * s_23], -1),
        torch.stack([-s_23, torch.zeros_like(c_1), -c_23], -1),
    ]
    return torch.stack(rows, -2)
