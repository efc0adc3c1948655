"""Convert rows to the twists of a textbook robot, so that one set of formulas also covers mirrored robots.

`RotX(pi) · RotZ(t) · Trans(a, 0, d) = RotZ(-t) · Trans(a, 0, -d) · RotX(pi)`: a twist that differs by 180 deg from that
of the textbook changes the sign of t and d in all later rows; the remaining RotX becomes part of the tool.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import (
    IDENTITY,
    Frame,
    as_transform,
    compose_row,
    compose_xyz_zyx,
    cosine_sine,
    rotate_x,
)
from pisigma.robot.row import JointType


@dataclass(frozen=True, eq=False)
class CanonicalRows:
    """A robot as a product of rows with canonical twists.

    `T_base_tool = T_base_first · Π RotZ(t_i) Trans(a_i, 0, d_i) RotX(twist_i) · RotZ(t_n) · T_last_tool`. The
    joint variable v (t of a revolute, d of a prismatic joint) is `sign · (direction · q + offset)`.

    Attributes:
        T_base_first: frame before the first joint, from the base and leading fixed rows.
        T_last_tool: tool in the last joint's frame after its rotation: the remainder of the row, trailing fixed rows
            and tool.
        sign: +1 or -1 for every joint.
        direction: +1 or -1 for every joint, the sign of the controller's values.
        offset: theta [rad] of a revolute and d [m] of a prismatic row.
        theta: sign · theta [rad] of every joint's row.
        d: sign · d [m] of every joint's row.
        a: a [m] of every joint's row.
    """

    T_base_first: Float64[Tensor, "4 4"]
    T_last_tool: Float64[Tensor, "4 4"]
    sign: Float64[Tensor, " dof"]
    direction: Float64[Tensor, " dof"]
    offset: Float64[Tensor, " dof"]
    theta: tuple[float, ...]
    d: tuple[float, ...]
    a: tuple[float, ...]

    def joint_values(self, variables: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch dof"]:
        """Convert canonical variables to joint values [rad or m]."""
        sign, direction, offset = (x.to(variables) for x in (self.sign, self.direction, self.offset))
        return direction * (sign * variables - offset)

    def variable_at_zero(self, joint: int) -> float:
        """Return the canonical variable of a joint whose joint value is 0."""
        return float(self.sign[joint] * self.offset[joint])


def canonical_rows(robot: Robot, types: Sequence[JointType], twists: Sequence[float]) -> CanonicalRows | None:
    """Convert the rows to the given twists [rad], or return None if the robot has different joints or twists.

    Args:
        robot: the robot; fixed rows are allowed only before the first and after the last joint.
        types: required joint types.
        twists: alpha of every joint's row except the last, modulo 180 deg; beta must be 0 in these rows.
    """
    joint_rows = robot.joint_rows
    first, last = joint_rows[0], joint_rows[-1]
    if tuple(row.type for row in robot.joints) != tuple(types) or last - first + 1 != len(joint_rows):
        return None
    signs = [1.0]
    for (_, _, _, alpha, beta), twist in zip(robot.dh[first:last].tolist(), twists, strict=True):
        cosine, sine = cosine_sine(alpha - twist)
        if beta != 0.0 or sine != 0.0:
            return None
        signs.append(signs[-1] * float(cosine))
    dh = robot.dh[first : last + 1].tolist()
    offset = [
        row[1] if joint.type == "prismatic" else row[0] for joint, row in zip(robot.joints, dh, strict=True)
    ]
    frame = rotate_x(IDENTITY, 0.0 if signs[-1] > 0 else math.pi)
    frame = compose_row(frame, (0.0, *dh[-1][1:]))
    like = torch.zeros((), dtype=torch.float64)
    return CanonicalRows(
        T_base_first=as_transform(
            _follow_fixed(robot, compose_xyz_zyx(IDENTITY, robot.base.tolist()), 0, first), like
        ),
        T_last_tool=as_transform(
            compose_xyz_zyx(_follow_fixed(robot, frame, last + 1, len(robot.rows)), robot.tool.tolist()), like
        ),
        sign=torch.tensor(signs, dtype=torch.float64),
        direction=torch.from_numpy(robot.directions),
        offset=torch.tensor(offset, dtype=torch.float64),
        theta=tuple(sign * row[0] for sign, row in zip(signs, dh, strict=True)),
        d=tuple(sign * row[1] for sign, row in zip(signs, dh, strict=True)),
        a=tuple(row[2] for row in dh),
    )


def _follow_fixed(robot: Robot, frame: Frame, start: int, stop: int) -> Frame:
    for parameters in robot.dh[start:stop].tolist():
        frame = compose_row(frame, parameters)
    return frame
