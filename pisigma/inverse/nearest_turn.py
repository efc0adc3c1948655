"""Full turns of revolute joints: the same pose, another joint value."""

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.kinematics.tolerances import LIMIT_TOLERANCE
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot


def nearest_turn(
    robot: Robot, q: Float[Tensor, "*batch dof"], near: Float[Tensor, "... dof"], within_limits: bool
) -> Float[Tensor, "*batch dof"]:
    """Move revolute joints by full turns as near to given values as they can come.

    Args:
        robot: the robot.
        q: joint values [rad or m]; NaN stays NaN.
        near: where they shall come near to [rad or m]; broadcasts.
        within_limits: only to turns inside the joint limits; a joint that no turn brings inside stays.
    """
    turns = torch.round((near - q) / (2 * torch.pi))
    if within_limits:
        limits = torch.from_numpy(robot.limits).to(q)
        lowest = torch.ceil((limits[:, 0] - LIMIT_TOLERANCE - q) / (2 * torch.pi))
        highest = torch.floor((limits[:, 1] + LIMIT_TOLERANCE - q) / (2 * torch.pi))
        nearest = torch.maximum(torch.minimum(turns, highest), lowest)
        turns = torch.where(lowest <= highest, nearest, torch.zeros_like(turns))
    revolute = torch.tensor(robot.revolute, device=q.device)
    return torch.where(revolute & (turns != 0), q + 2 * torch.pi * turns, q)


def as_trained(model: CalibratedModel, q: Tensor) -> Tensor:
    """Joint values `(*batch, dof)` turned as those of the training rows, which a network knows."""
    if not len(model.starts):
        return q
    lower, upper = model.starts.aminmax(dim=0)
    return nearest_turn(model.robot, q, (lower + upper).double() / 2, within_limits=False)
