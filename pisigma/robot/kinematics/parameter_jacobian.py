"""Identification Jacobian: derivative of the tool pose with respect to all geometric parameters, batched.

Every parameter is a translation along, or a rotation about, an axis that forward kinematics computes anyway:

    theta_i  rotates about z of the frame before the row       d_i  translates along it
    alpha_i  rotates about x of the frame after RotZ           a_i  translates along it
    beta_i   rotates about y of the frame after RotX

A translation along u moves the tool by u; a rotation about u through o moves it by `u × (p_tool - o)` and rotates it
about u. This is the error propagation of Lim et al. 1999, eqs. (8) to (33), in the base frame instead of the tool
frame.

Axes and origins are stored as `(3, poses)` blocks of a few large tensors: few operations for small batches, whole
cache lines for large ones.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float64, Int64
from torch import Tensor

from pisigma.robot.description import Robot

JACOBIAN_CHUNK = 2_048
"""Number of poses that are processed together, so that their Jacobian stays in the processor's cache."""


AXES, _ORIGIN = slice(6, 9), 9
"""Indices of x, y, z and of the origin in `_frame_axes`."""
_STARTS = torch.tensor((0, 0, 0, 1, 1, _ORIGIN, 2, 6, 6, 6, 7, 10, _ORIGIN, 8))
"""Indices in `_frame_axes` of the vectors that start the recursion of `_walk_rows`: rotation axes of the base, then
its frame."""


@dataclass(frozen=True, eq=False)
class ToolMotion:
    """Tool pose and its derivative with respect to the geometric parameters; the batch index is last.

    Attributes:
        position: position of the tool in the measuring frame [m].
        rotation: rotation of the tool in the measuring frame.
        derivative: for every parameter, the tool's translation [m] and, if requested, its rotation [rad], both in the
            measuring frame, in the order of `parameter_order`.
    """

    position: Float[Tensor, "3 poses"]
    rotation: Float[Tensor, "3 3 poses"]
    derivative: Float[Tensor, "parameters components poses"]


def parameter_order(rows: int) -> list[int]:
    """Return the index of every parameter in `ToolMotion.derivative`, where rotations precede translations.

    The rotation axes are every third vector of `_walk_rows`; some of them belong to no parameter.

    Returns:
        The indices of theta, d, a, alpha, beta of every row, then of base and tool (x, y, z, roll, pitch, yaw each).
    """
    d, a, base, tool = (start + 3 * rows + 9 for start in (0, rows, 2 * rows, 2 * rows + 3))
    order = [
        index for row in range(rows) for index in (3 * row + 5, d + row, a + row, 3 * row + 6, 3 * row + 7)
    ]
    return [*order, base, base + 1, base + 2, 0, 1, 2, tool, tool + 1, tool + 2, d - 3, d - 2, d - 1]


def identification_jacobian(
    robot: Robot, q: Float[Tensor, "*batch dof"]
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 6 parameters"]]:
    """Compute the tool pose and its derivative with respect to all geometric parameters.

    Args:
        robot: the robot.
        q: joint values [rad or m].

    Returns:
        T_base_tool, and J with `J @ dx` = [translation [m]; rotation vector [rad]] of the tool, both in the
        measuring frame. Columns: theta, d, a, alpha, beta of every row, then base and tool (x, y, z, roll,
        pitch, yaw each).

    Raises:
        PoseError: the number of columns of q is not the number of joints.
    """
    robot.check_joint_count(q.shape[-1])
    flat = q.reshape(-1, robot.dof)
    base, tool = (flat.new_tensor(frame)[:, None] for frame in (robot.base, robot.tool))
    order = parameter_order(len(robot.rows))
    T = flat.new_zeros((flat.shape[0], 4, 4))
    T[:, 3, 3] = 1
    J = flat.new_empty((flat.shape[0], 6, len(order)))
    for start in range(0, flat.shape[0], JACOBIAN_CHUNK):
        part = slice(start, start + JACOBIAN_CHUNK)
        motion = tool_motion(robot, robot.dh, base, tool, flat[part], with_rotation=True)
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
    with_rotation: bool,
    frame: Int64[Tensor, " poses"] | None = None,
    target: Int64[Tensor, " poses"] | None = None,
) -> ToolMotion:
    """Compute the tool pose and its derivative, with the batch index last.

    Args:
        robot: robot with the types and directions of the rows.
        dh: parameters of the rows.
        base: x, y, z [m], roll, pitch, yaw [rad] of the base; one for all poses, or one per measuring frame.
        tool: x, y, z [m], roll, pitch, yaw [rad] of the tool; one for all poses, or one per target.
        q: joint values [rad or m].
        with_rotation: whether to also compute the derivative of the rotation.
        frame: index of the base for every pose, if there are several.
        target: index of the tool for every pose, if there are several.
    """
    poses = q.shape[0]
    axes, bases = _frame_axes(torch.cat([base, tool], 1), q), base.shape[1]
    base_axes, tool_axes = axes[..., :bases], axes[..., bases:]
    if frame is not None:
        base_axes = base_axes[..., frame]
    if target is not None:
        tool_axes = tool_axes[..., target]
    frames = _walk_rows(robot, dh, q, base_axes)
    tool_steps = _behind(_last(frames), tool_axes)
    position = tool_steps[_ORIGIN]
    shifts = 3 * frames.shape[0] + 3
    J = q.new_empty((5 * len(robot.rows) + 15, 6 if with_rotation else 3, poses))
    turns = frames[:, ::3]
    u, v = turns.unbind(2), (position - frames[:, 5])[:, None].unbind(2)
    of_turns = J[: shifts - 3].view(-1, 3, J.shape[1], poses)
    for k in range(3):  # the cross product of the axes and the vectors from the origins to the tool
        i, j = (k + 1) % 3, (k + 2) % 3
        torch.mul(u[i], v[j], out=of_turns[:, :, k]).addcmul_(u[j], v[i], value=-1)
    base_steps = base_axes[3:6, :3].expand(-1, -1, poses)
    torch.cat([frames[1:-1, 6], frames[2:, 0], base_steps, tool_steps[3:6]], out=J[shifts:, :3])
    J[shifts - 3 : shifts, :3] = 0
    if with_rotation:
        of_turns[:, :, 3:] = turns
        J[shifts - 3 : shifts, 3:] = tool_steps[:3]
        J[shifts:, 3:] = 0
    return ToolMotion(position, tool_steps[AXES].transpose(0, 1), J)


def flange_frames(
    robot: Robot, q: Float[Tensor, "poses dof"]
) -> tuple[Float[Tensor, "poses 3 3"], Float[Tensor, "poses 3"]]:
    """Return rotation and position [m] after the last row in the frame of the first row, without base and tool."""
    last = _last(_walk_rows(robot, robot.dh, q, _frame_axes(q.new_zeros(6, 1), q)))
    return last[:3].permute(2, 1, 0).contiguous(), last[3].t().contiguous()


def _walk_rows(
    robot: Robot, dh: Float64[np.ndarray, "rows 5"], q: Tensor, base_axes: Tensor
) -> Float[Tensor, "rows_and_2 7 3 poses"]:
    """Compute the frames from the base to the last row.

    The rotation about z is `(x, y) cos + (y, -x) sin`; one small matrix leads from a rotated frame to the next row.

    Returns:
        For every row and the frame after the last one: x and y as rotated by the previous row, then x, y, -x, origin
        and z before the row. Every third vector is a rotation axis of a parameter, through this origin. The first entry
        contains the rotation axes of the base (roll, pitch, yaw) and its origin in the same form.
    """
    frames = q.new_empty((len(robot.rows) + 2, 7, 3, q.shape[0]))
    starts = base_axes.index_select(0, _STARTS.to(q.device))[:, :3]
    frames[:2].flatten(0, 1).copy_(starts)
    offsets = q.new_tensor(dh[:, :1])
    angles = torch.addmm(offsets, torch.from_numpy(_turning(robot)).to(q), q.t())
    before, turned, flat, matrices = frames[1:-1], frames[2:, :2], frames.flatten(0, 1), _row_matrices(dh, q)
    blocks = (turned, before[:, 2:4], before[:, 3:5], angles.cos(), angles.sin())
    turns = zip(*(block.unbind(0) for block in blocks), strict=True)
    sliding = {
        row: joint for joint, row in enumerate(robot.joint_rows) if robot.rows[row].type == "prismatic"
    }
    for row, (after, xy, side, cosine, sine) in enumerate(turns):
        torch.mul(xy, cosine, out=after).addcmul_(side, sine)
        start = 7 * row + 12
        torch.mm(
            matrices[row], flat[start : start + 4].flatten(1), out=flat[start + 4 : start + 9].flatten(1)
        )
        if row in sliding:
            joint = sliding[row]
            frames[row + 2, 5].addcmul_(frames[row + 1, 6], q[:, joint], value=robot.directions[joint])
    return frames


def _last(frames: Float[Tensor, "rows_and_2 7 3 poses"]) -> Float[Tensor, "4 3 poses"]:
    """Return the axes x, y, z and the origin of the frame after the last row."""
    return torch.cat([frames[-1, 2:4], frames[-1, 6:], frames[-1, 5:6]])


def _row_matrices(dh: Float64[np.ndarray, "rows 5"], like: Tensor) -> Float[Tensor, "rows 5 4"]:
    """Return for every row the matrix from origin, z and rotated x, y before it to x, y, -x, origin, z after it.

    It is `Trans(a, 0, d) · RotX(alpha) · RotY(beta)`; the motion of a prismatic joint is added separately.
    """
    _, d, a, alpha, beta = dh.T
    ca, cb, sa, sb = np.cos(alpha), np.cos(beta), np.sin(alpha), np.sin(beta)
    matrices = np.zeros((len(d), 5, 4))
    x, y, minus_x, origin, z = (matrices[:, i] for i in range(5))
    x[:, 1], x[:, 2], x[:, 3] = -ca * sb, cb, sa * sb
    y[:, 1], y[:, 3] = sa, ca
    np.negative(x, out=minus_x)
    origin[:, 0], origin[:, 1], origin[:, 2] = 1, d, a
    z[:, 1], z[:, 2], z[:, 3] = ca * cb, sb, -sa * cb
    return torch.from_numpy(matrices).to(like)


@lru_cache(maxsize=16)
def _turning(robot: Robot) -> Float64[np.ndarray, "rows dof"]:
    """Return the rotation of every row per joint value; cached, because every step of an iteration needs it."""
    turning = np.zeros((len(robot.rows), robot.dof))
    turning[robot.joint_rows, range(robot.dof)] = robot.directions * robot.revolute
    return turning


def _frame_axes(xyz_zyx: Float[Tensor, "6 frames"], like: Tensor) -> Float[Tensor, "11 4 frames"]:
    """Return rotation axes (roll, pitch, yaw), translation axes (x, y, z) and the frame x, y, z, origin, -x of frames.

    All are coefficients of the axes x, y, z and the origin before
    `Trans(x, y, z) · RotZ(roll) · RotY(pitch) · RotX(yaw)`.
    """
    values = xyz_zyx.cpu().numpy()
    (cr, cp, cy), (sr, sp, sy) = np.cos(values[3:]), np.sin(values[3:])
    spsy, spcy = sp * sy, sp * cy
    x = (cr * cp, sr * cp, -sp)
    y = (cr * spsy - sr * cy, sr * spsy + cr * cy, cp * sy)
    z = (cr * spcy + sr * sy, sr * spcy - cr * sy, cp * cy)
    axes = np.zeros((11, 4, values.shape[1]))
    axes[0, 2] = axes[3, 0] = axes[4, 1] = axes[5, 2] = axes[9, 3] = 1
    axes[1, 0], axes[1, 1] = -sr, cr
    axes[6:9, :3] = np.array((*x, *y, *z)).reshape(3, 3, -1)
    axes[2], axes[10] = axes[6], -axes[6]
    axes[9, :3] = values[:3]
    return torch.from_numpy(axes).to(like)


def _behind(
    frame: Float[Tensor, "4 3 poses"], axes: Float[Tensor, "size 4 ways"]
) -> Float[Tensor, "size 3 poses"]:
    """Transform axes and origins from a frame to the measuring frame."""
    if axes.shape[-1] > 1:
        result: Tensor = (axes[:, :, None] * frame).sum(1)
        return result
    return (axes[..., 0] @ frame.flatten(1)).view(-1, 3, frame.shape[-1])


class MotionMemory:
    """Cache of the tool motion at the last point, which rank analysis and search both need.

    The inputs of the motion are compared by identity; therefore points must be replaced, not changed in place.
    """

    def __init__(self) -> None:
        self._made_from: tuple[object, ...] = ()
        self._motion: ToolMotion | None = None

    def motion(self, made_from: tuple[object, ...], make: Callable[[], ToolMotion]) -> ToolMotion:
        """Return the cached motion if it was computed from the same objects, otherwise a new motion.

        Args:
            made_from: the objects from which the motion is computed.
            make: function that computes the motion.
        """
        same = len(made_from) == len(self._made_from) and all(
            one is other for one, other in zip(made_from, self._made_from, strict=True)
        )
        if not same or self._motion is None:
            self._made_from, self._motion = made_from, None  # release memory before more is allocated
            self._motion = make()
        return self._motion
