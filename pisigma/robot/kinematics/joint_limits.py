"""Joint limits: shift values into them by full turns, and detect values that cannot belong to the joint."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE
from pisigma.robot.row import Row
from pisigma.robot.se3 import wrap_to_pi


def wrapped_difference(
    robot: Robot, q: Float[Tensor, "*#batch dof"], other: Float[Tensor, "*#batch dof"]
) -> Float[Tensor, "*_batch dof"]:
    """Return `q - other` [rad or m], wrapped to (-pi, pi] for revolute joints; the batches broadcast."""
    difference = q - other
    return torch.where(torch.tensor(robot.revolute, device=q.device), wrap_to_pi(difference), difference)


def wrap_into_limits(
    robot: Robot, q: Float[Tensor, "*batch dof"]
) -> tuple[Float[Tensor, "*batch dof"], Bool[Tensor, "*batch"]]:
    """Shift revolute joints that are outside their limits by full turns, if this brings them inside.

    Args:
        robot: the robot with the limits; for coupled joints, those of the controller's values.
        q: joint values [rad or m]; NaN stays NaN.

    Returns:
        The joint values, and whether all joints of a pose are inside (False for NaN). A value that no full turn brings
        inside is unchanged.
    """
    limits = torch.from_numpy(robot.limits).to(q)
    # Values in float32 are rounded by more than LIMIT_TOLERANCE.
    tolerance = max(LIMIT_TOLERANCE, 8 * torch.finfo(q.dtype).eps)
    lower, upper = limits[:, 0] - tolerance, limits[:, 1] + tolerance
    turn = 2 * torch.pi * torch.tensor(robot.revolute).to(q)
    up = torch.where(q < lower, torch.ceil((lower - q) / (2 * torch.pi)), 0.0)
    down = torch.where(q > upper, torch.ceil((q - upper) / (2 * torch.pi)), 0.0)
    moved = q + (up - down) * turn
    inside = (moved >= lower) & (moved <= upper)
    moved, every = torch.where(inside, moved, q), inside.all(-1)
    # A full turn of a coupled joint also turns others, so the controller's values decide which turns are possible.
    if robot.coupling is None:
        return moved, every
    turned, allowed = robot.coupling.wrapped_within_limits(
        moved.detach().double().cpu().numpy().reshape(-1, robot.dof)
    )
    return torch.from_numpy(turned).to(q).reshape(q.shape), every & torch.from_numpy(allowed).to(
        every
    ).reshape(every.shape)


def nearest_turn(
    robot: Robot, q: Float[Tensor, "*batch dof"], near: Float[Tensor, "... dof"], within_limits: bool
) -> Float[Tensor, "*batch dof"]:
    """Shift revolute joints by full turns to the values nearest to a reference.

    Args:
        robot: the robot.
        q: joint values [rad or m]; NaN stays NaN.
        near: reference values [rad or m]; broadcasts.
        within_limits: consider only turns inside the joint limits; a joint without such a turn is unchanged.
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


_GROSS_ANGLE = np.pi / 4
"""Excess over the limits [rad] above which a value must belong to another joint, be in another unit, or be relative to
another zero; limits stated for published robots were wrong by up to 14 deg."""
_GROSS_SHARE = 0.25
"""Excess over the limits of a prismatic joint, as a share of its stroke, above which a value must belong to another
joint, be in another unit, or be relative to another zero."""


def beyond_limits(
    q: Float64[np.ndarray, " rows"], axis: Row, tolerance: float = LIMIT_TOLERANCE
) -> Bool[np.ndarray, " rows"]:
    """Return the mask of values [rad or m] that exceed the limits of an axis by more than `tolerance`."""
    outside: np.ndarray = (q < axis.lower - tolerance) | (q > axis.upper + tolerance)
    return outside


def far_beyond_limits(q: Float64[np.ndarray, " rows"], axis: Row) -> Bool[np.ndarray, " rows"]:
    """Return the mask of values that cannot belong to an axis, even if its stated limits are inaccurate."""
    stroke = axis.upper - axis.lower
    return beyond_limits(q, axis, _GROSS_SHARE * stroke if axis.type == "prismatic" else _GROSS_ANGLE)
