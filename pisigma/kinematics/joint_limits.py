"""Full turns of joints: differences the short way round, and joint values inside their limits where that can be."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.kinematics.tolerances import LIMIT_TOLERANCE
from pisigma.robot.description import Robot
from pisigma.se3 import wrap_to_pi


def wrapped_difference(
    robot: Robot, q: Float[Tensor, "*#batch dof"], other: Float[Tensor, "*#batch dof"]
) -> Float[Tensor, "*_batch dof"]:
    """`q - other` [rad or m], wrapped to (-pi, pi] for the joints that turn; the batches broadcast."""
    difference = q - other
    return torch.where(torch.tensor(robot.revolute, device=q.device), wrap_to_pi(difference), difference)


def wrap_into_limits(
    robot: Robot, q: Float[Tensor, "*batch dof"]
) -> tuple[Float[Tensor, "*batch dof"], Bool[Tensor, "*batch"]]:
    """Move revolute joints that are outside their limits by full turns where that brings them inside.

    Args:
        robot: the robot, for the limits; where joints are coupled, those of the controller's values.
        q: joint values [rad or m]; NaN stays NaN.

    Returns:
        The joint values, and whether all joints of a pose are inside (False where one is NaN). A value that
        no full turn brings inside is left as it came.
    """
    limits = torch.from_numpy(robot.limits).to(q)
    tolerance = max(LIMIT_TOLERANCE, 8 * torch.finfo(q.dtype).eps)
    lower, upper = limits[:, 0] - tolerance, limits[:, 1] + tolerance
    turn = 2 * torch.pi * torch.tensor(robot.revolute).to(q)
    up = torch.where(q < lower, torch.ceil((lower - q) / (2 * torch.pi)), 0.0)
    down = torch.where(q > upper, torch.ceil((q - upper) / (2 * torch.pi)), 0.0)
    moved = q + (up - down) * turn
    inside = (moved >= lower) & (moved <= upper)
    moved, every = torch.where(inside, moved, q), inside.all(-1)
    if robot.coupling is None:
        return moved, every
    turned, allowed = robot.coupling.turned_inside(
        moved.detach().double().cpu().numpy().reshape(-1, robot.dof)
    )
    return torch.from_numpy(turned).to(q).reshape(q.shape), every & torch.from_numpy(allowed).to(
        every
    ).reshape(every.shape)
