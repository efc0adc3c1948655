"""Pose errors and Jacobians in the tool axes of a task; see `kinematics.task_axes.TaskAxes`."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.robot.kinematics.task_axes import TaskAxes
from pisigma.robot.se3 import pose_error


def task_error(
    axes: TaskAxes, T: Float[Tensor, "poses 4 4"], reached: Float[Tensor, "poses 4 4"]
) -> tuple[Float[Tensor, "poses 6"], Float[Tensor, "poses 6 6"]]:
    """Compute pose errors in all tool axes, and the matrices that convert pose Jacobians to Jacobians of the errors.

    With the rotation D from the reached to the target tool, the swing of a tool axis k is
    `atan2(|k × Dk|, k · Dk)` about `k × Dk`, and the twist about it is `atan2(D_ji - D_ij, D_ii + D_jj)` with i, j, k
    cyclic, with the derivative `(k + Dk) · ω / (1 + k · Dk)`. Derivatives of rotation vectors and swings are those for
    small rotations, as in all Gauss-Newton steps of this package.

    Args:
        axes: the task.
        T: target T_base_tool [m].
        reached: reached T_base_tool [m].

    Returns:
        Errors [m, rad] in the order of `AXES`, and the matrices.
    """
    zero = torch.zeros_like(T[:, :3, :3])
    turn, D = reached[:, :3, :3].mT, reached[:, :3, :3].mT @ T[:, :3, :3]
    rotation, k = turn, axes.pivot
    # Shifts along the axes of the target tool, rotations about those of the reached one.
    error = pose_error(T, reached)
    error = torch.cat(
        [(T[:, :3, :3].mT @ error[:, :3, None])[..., 0], (turn @ error[:, 3:, None])[..., 0]], -1
    )
    if k >= 0:
        i, j = (k + 1) % 3, (k + 2) % 3
        sine = torch.hypot(D[:, i, k], D[:, j, k])
        # angle / sine tends to 1 at 0; at 180 deg, the axis of the swing is arbitrary, so no swing is requested there.
        straight = torch.where(D[:, k, k] > 0, 1.0, 0.0).to(D)
        safe = torch.where(sine > 1e-12, sine, 1.0)
        factor = torch.where(sine > 1e-12, torch.atan2(sine, D[:, k, k]) / safe, straight)
        error[:, 3 + i], error[:, 3 + j] = -factor * D[:, j, k], factor * D[:, i, k]
        error[:, 3 + k] = torch.atan2(D[:, j, i] - D[:, i, j], D[:, i, i] + D[:, j, j])
        # (k + Dk) / (1 + k · Dk), with the component along k of exactly 1; the clamp bounds steps near 180 deg.
        direction = D[:, :, k] / (1 + D[:, k, k]).clamp(min=0.05)[:, None]
        direction[:, k] = 1.0
        rotation = turn.clone()
        rotation[:, k] = (direction[:, None] @ turn)[:, 0]
    matrix = torch.cat([torch.cat([T[:, :3, :3].mT, zero], -1), torch.cat([zero, rotation], -1)], -2)
    return error, matrix


def is_within_tolerances(axes: TaskAxes, error: Float[Tensor, "*batch 6"]) -> Bool[Tensor, "*batch"]:
    """Return whether errors in the tool axes are within all tolerances."""
    allowed = [abs(value) * (1 + 1e-9) if value else math.inf for value in axes.tolerance]
    within: Tensor = (error.abs() <= error.new_tensor(allowed)).all(-1)
    return within
