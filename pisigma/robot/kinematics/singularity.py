"""Distance of joint values from a singularity."""

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import joint_jacobian


def characteristic_length(robot: Robot) -> float:
    """Return the length that makes translations comparable with rotations: the reach [m], or 1 m if that is 0."""
    return robot.reach or 1.0


def dimensionless_jacobian(robot: Robot, J: Float[Tensor, "*batch 6 dof"]) -> Float[Tensor, "*batch 6 dof"]:
    """Return the joint Jacobian with all lengths in units of the characteristic length.

    Rows of translation are divided by that length, columns of prismatic joints multiplied by it.
    """
    length = characteristic_length(robot)
    rows = J.new_tensor([1 / length] * 3 + [1.0] * 3)
    columns = J.new_tensor([1.0 if revolute else length for revolute in robot.revolute])
    return rows[:, None] * J * columns


def singularity_measure(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch"]:
    """Return the smallest singular value of the joint Jacobian in characteristic lengths (`dimensionless_jacobian`).

    It is 0 at a singularity and at most about 1. It is close to the sine of the angle by which a joint differs from its
    singular value, so that 0.05 means about 3 deg.

    Args:
        robot: the robot.
        q: joint values [rad or m].

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    _, J = joint_jacobian(robot, q)
    return smallest_singular_value(robot, J)


def smallest_singular_value(
    robot: Robot, J: Float[Tensor, "*batch 6 dof"], rows: int = 6
) -> Float[Tensor, "*batch"]:
    """Return the `singularity_measure` of a known joint Jacobian, of which all but the given number of rows are 0."""
    values: Tensor = torch.linalg.svdvals(dimensionless_jacobian(robot, J).contiguous())
    return values[..., min(rows, robot.dof) - 1]
