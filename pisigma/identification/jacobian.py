"""Identification Jacobian: derivative of the tool pose by every geometric parameter, closed form and batched.

Every parameter is a shift along, or a turn about, an axis that the walk along the rows passes anyway:

    theta_i  turns about z of the frame before the row       d_i  shifts along it
    alpha_i  turns about x of the frame after RotZ           a_i  shifts along it
    beta_i   turns about y of the frame after RotX

A shift along u moves the tool by u; a turn about u through o moves it by `u × (p_tool - o)` and turns it by
u. This is the error propagation of Lim et al. 1999, eqs. (8) to (33), written in the base frame instead of
the tool's.

Frames are kept as four `(3, poses)` tensors (columns x, y, z of the rotation, and the origin): few
operations for small batches, whole cache lines for large ones.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.robot.description import Robot

Columns = tuple[Tensor, Tensor, Tensor, Tensor]

JACOBIAN_CHUNK = 2_048
"""Poses worked on together, so that their Jacobian stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Where the tool is and how it moves with the parameters; the batch index is last.

    Attributes:
        position: of the tool in the measuring frame [m].
        rotation: of the tool in the measuring frame.
        derivative: for every parameter the tool's shift [m] and, where asked for, its turn [rad], both in the
            measuring frame; the order is that of `motion_order`.
    """

    position: Float[Tensor, "3 poses"]
    rotation: Float[Tensor, "3 3 poses"]
    derivative: Float[Tensor, "parameters components poses"]


def motion_order(rows: int) -> list[int]:
    """Where the parameters stand in `ToolMotion.derivative`, which has all turns before all shifts.

    Returns:
        For theta, d, a, alpha, beta of every row, then base and tool (x, y, z, roll, pitch, yaw each), its
        index.
    """
    theta, alpha, beta, d, a = 0, rows, 2 * rows, 3 * rows + 6, 4 * rows + 6
    order = [start + row for row in range(rows) for start in (theta, d, a, alpha, beta)]
    base = [*range(5 * rows + 6, 5 * rows + 9), *range(3 * rows, 3 * rows + 3)]
    return order + base + [index + 3 for index in base]


def identification_jacobian(
    robot: Robot, q: Float[Tensor, "*batch dof"]
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 6 parameters"]]:
    """Tool pose and its derivative by all geometric parameters.

    Args:
        robot: the robot.
        q: joint values [rad or m], as the controller counts.

    Returns:
        T_base_tool, and J with `J @ dx` = [shift [m]; rotation vector [rad]] of the tool, both in the
        measuring frame. Columns: theta, d, a, alpha, beta of every row, then base and tool (x, y, z, roll,
        pitch, yaw each).

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    robot.check_joint_count(q.shape[-1])
    flat = q.reshape(-1, robot.dof)
    base, tool = (flat.new_tensor(frame)[:, None] for frame in (robot.base, robot.tool))
    order = motion_order(len(robot.rows))
    T = flat.new_zeros((flat.shape[0], 4, 4))
    T[:, 3, 3] = 1
    J = flat.new_empty((flat.shape[0], 6, len(order)))
    for start in range(0, flat.shape[0], JACOBIAN_CHUNK):
        part = slice(start, start + JACOBIAN_CHUNK)
        motion = tool_motion(robot, robot.dh, base, tool, flat[part], turning=True)
        T[part, :3, :3] = motion.rotation.permute(2, 0, 1)
        T[part, :3, 3] = motion.position.t()
        J[part] = motion.derivative[order].permute(2, 1, 0)
    return T.reshape(*q.shape[:-1], 4, 4), J.reshape(*q.shape[:-1], 6, J.shape[-1])


def tool_motion(
    robot: Robot,
    dh: Float64[np.ndarray, "rows 5"],
    base: Float[Tensor, "6 bases"],
    tool: Float[Tensor, "6 tools"],
    q: Float[Tensor, "poses dof"],
    turning: bool,
) -> ToolMotion:
    """Tool pose and its derivative, with the batch index last.

    Args:
        robot: says which rows move.
        dh: the parameters of the rows.
        base: x, y, z [m], roll, pitch, yaw [rad]; one for all poses or one a pose.
        tool: the same.
        q: joint values [rad or m].
        turning: whether the derivative of the rotation is wanted too.
    """
    shape = (3, q.shape[0])
    x, y, z = (axis.expand(shape) for axis in torch.eye(3, dtype=q.dtype, device=q.device)[:, :, None])
    base_steps = _walk_frame((x, y, z, torch.zeros_like(x)), base)
    rows = _walk_rows(robot, dh, q, base_steps[-1])
    tool_steps = _walk_frame(rows.last, tool)
    x, y, z, position = tool_steps[-1]
    base_turns, tool_turns = _turning_axes(base_steps), _turning_axes(tool_steps)
    turns = torch.stack([*rows.z, *rows.x, *rows.y, *base_turns, *tool_turns])
    origins = [*rows.before, *rows.moved, *rows.moved, *[base_steps[1][3]] * 3, *[position] * 3]
    arms = position - torch.stack(origins)
    shifts = [*rows.z, *rows.x, *base_steps[0][:3], *tool_steps[0][:3]]
    J = q.new_empty((turns.shape[0] + len(shifts), 6 if turning else 3, shape[1]))
    for k in range(3):  # the cross product turns x arms
        i, j = (k + 1) % 3, (k + 2) % 3
        J[: len(turns), k] = torch.addcmul(turns[:, i] * arms[:, j], turns[:, j], arms[:, i], value=-1)
    torch.stack(shifts, out=J[len(turns) :, :3])
    if turning:
        J[: len(turns), 3:] = turns
        J[len(turns) :, 3:] = 0
    return ToolMotion(position, torch.stack([x, y, z], 1), J)


@dataclass(frozen=True, eq=False)
class _RowAxes:
    """Per row the axes z before, x turned and y twisted, and the origins before and moved."""

    z: list[Tensor]
    x: list[Tensor]
    y: list[Tensor]
    before: list[Tensor]
    moved: list[Tensor]
    last: Columns


def _walk_rows(robot: Robot, dh: Float64[np.ndarray, "rows 5"], q: Tensor, frame: Columns) -> _RowAxes:
    offsets = dh[list(robot.joint_rows), [0 if turns else 1 for turns in robot.revolute]]
    values = q.t() * q.new_tensor(robot.directions)[:, None] + q.new_tensor(offsets)[:, None]
    joints = iter(zip(values.unbind(), values.cos().unbind(), values.sin().unbind(), strict=True))
    walked = _RowAxes([], [], [], [], [], frame)
    x, y, z, p = frame
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, dh.tolist(), strict=True):
        value, cosine, sine = next(joints) if row.type != "fixed" else (d, math.cos(theta), math.sin(theta))
        if row.type == "prismatic":
            cosine, sine = math.cos(theta), math.sin(theta)
        walked.z.append(z)
        walked.before.append(p)
        x, y = _turn(x, y, cosine, sine)
        p = torch.add(torch.add(p, z * (d if row.type == "revolute" else value)), x, alpha=a)
        walked.x.append(x)
        walked.moved.append(p)
        y, z = _turn(y, z, math.cos(alpha), math.sin(alpha))
        walked.y.append(y)
        z, x = _turn(z, x, math.cos(beta), math.sin(beta))
    return replace(walked, last=(x, y, z, p))


def _turn(u: Tensor, v: Tensor, cosine: float | Tensor, sine: float | Tensor) -> tuple[Tensor, Tensor]:
    """The two axes `(u, v)` after a turn from u towards v."""
    if isinstance(cosine, Tensor) and isinstance(sine, Tensor):
        return torch.addcmul(u * cosine, v, sine), torch.addcmul(v * cosine, u, sine, value=-1)
    assert isinstance(sine, float)
    if sine == 0.0 and cosine == 1.0:
        return u, v
    return torch.add(u * cosine, v, alpha=sine), torch.add(v * cosine, u, alpha=-sine)


def _walk_frame(frame: Columns, xyzrpy: Tensor) -> tuple[Columns, Columns, Columns, Columns]:
    """Walk along `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.

    Returns:
        The frame before, after the shift and the roll, after the pitch, after the yaw.
    """
    x, y, z, p = frame
    cosine, sine = xyzrpy[3:].cos(), xyzrpy[3:].sin()
    p = p + x * xyzrpy[0] + y * xyzrpy[1] + z * xyzrpy[2]
    x1, y1 = _turn(x, y, cosine[0], sine[0])
    z2, x2 = _turn(z, x1, cosine[1], sine[1])
    y3, z3 = _turn(y1, z2, cosine[2], sine[2])
    return frame, (x1, y1, z, p), (x2, y1, z2, p), (x2, y3, z3, p)


def _turning_axes(steps: tuple[Columns, Columns, Columns, Columns]) -> tuple[Tensor, Tensor, Tensor]:
    """The axes that roll, pitch and yaw turn about."""
    before, rolled, pitched, _ = steps
    return before[2], rolled[1], pitched[0]
