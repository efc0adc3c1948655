"""Joint Jacobian of the tool pose in closed form, batched, and a measure of the distance from a singularity."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import (
    IDENTITY,
    Frame,
    Scalar,
    as_transform,
    compose_xyz_zyx,
    cross,
    product,
    stack_components,
    subtract,
)
from pisigma.robot.kinematics.forward import Geometry, iterate_chunks, iterate_rows


def joint_jacobian(
    robot: Robot, q: Float[Tensor, "*batch dof"]
) -> tuple[Float[Tensor, "*batch 4 4"], Float[Tensor, "*batch 6 dof"]]:
    """Compute the tool pose and the geometric Jacobian, in the base frame and at the tool's origin.

    Column j is `direction_j · [z × (p_tool - p); z]` for a revolute joint and `direction_j · [z; 0]` for a prismatic
    joint, where z and p are the axis and origin of the frame before the joint's row (Siciliano et al. 2009, eq. 3.30).

    Args:
        robot: the robot.
        q: joint values [rad or m].

    Returns:
        T_base_tool, and J with `J @ dq` = [translation [m]; rotation vector [rad]] of the tool, both in the
        base frame. Both may be views in which the batch dimension is contiguous; call ``.contiguous()`` if this
        matters.

    Raises:
        PoseError: the number of columns of q is not the number of joints.
    """
    robot.check_joint_count(q.shape[-1])
    batch = q.shape[:-1]
    geometry = Geometry.from_robot(robot)
    chunks = [_jacobian_chunk(robot, geometry, chunk) for chunk in iterate_chunks(q)]
    T, J = chunks[0]
    if len(chunks) > 1:
        T, J = _join([T for T, _ in chunks]), _join([J for _, J in chunks])
    return T.reshape(*batch, 4, 4), J.reshape(*batch, 6, robot.dof)


def _join(chunks: list[Tensor]) -> Tensor:
    """Concatenate chunks along the batch, which stays contiguous in memory."""
    return torch.cat([chunk.movedim(0, -1) for chunk in chunks], -1).movedim(-1, 0)


def _jacobian_chunk(
    robot: Robot, geometry: Geometry, q: Float[Tensor, "poses dof"]
) -> tuple[Float[Tensor, "poses 4 4"], Float[Tensor, "poses 6 dof"]]:
    columns = q.t().contiguous().unbind(0)
    tool, rows = motion_components(robot, geometry, columns)
    J = stack_components([value for entries in rows for value in entries], like=columns[0])
    return as_transform(tool, like=columns[0]), J.reshape(-1, 6, robot.dof)


def motion_components(
    robot: Robot, geometry: Geometry, q: Sequence[Scalar]
) -> tuple[Frame, list[list[Scalar]]]:
    """Compute the tool frame and the six rows of the joint Jacobian from components; see `joint_jacobian`.

    Args:
        robot: the robot.
        geometry: its parameters, or others for the same rows.
        q: one joint value [rad or m] per joint, each a tensor of the batch shape.
    """
    joints: list[Frame] = []
    frame = IDENTITY
    for row, frames in zip(robot.rows, iterate_rows(robot, geometry, q), strict=True):
        if row.type != "fixed":
            joints.append(frames.before)
        frame = frames.after
    tool = compose_xyz_zyx(frame, geometry.tool)
    rows: list[list[Scalar]] = [[] for _ in range(6)]
    for joint, before in zip(robot.joints, joints, strict=True):
        axis, origin = before[2], before[3]
        linear = axis if joint.type == "prismatic" else cross(axis, subtract(tool[3], origin))
        angular = (0.0, 0.0, 0.0) if joint.type == "prismatic" else axis
        for entries, value in zip(rows, (*linear, *angular), strict=True):
            entries.append(product(float(joint.direction), value))
    return tool, rows


def characteristic_length(robot: Robot) -> float:
    """Return the length that makes translations comparable with rotations: the reach [m], or 1 m if that is 0."""
    return robot.reach or 1.0


def dimensionless_jacobian(robot: Robot, J: Float[Tensor, "*batch 6 dof"]) -> Float[Tensor, "*batch 6 dof"]:
    """Return the joint Jacobian with lengths in units of the characteristic length.

    Rows of translation are divided by this length, and columns of prismatic joints are multiplied by it.
    """
    length = characteristic_length(robot)
    rows = J.new_tensor([1 / length] * 3 + [1.0] * 3)
    columns = J.new_tensor([1.0 if revolute else length for revolute in robot.revolute])
    return rows[:, None] * J * columns


def singularity_measure(robot: Robot, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch"]:
    """Return the smallest singular value of the joint Jacobian in characteristic lengths (`dimensionless_jacobian`).

    It is 0 at a singularity and at most about 1. It is close to the sine of the angle by which a joint differs from its
    singular value, so 0.05 means about 3 deg.

    Args:
        robot: the robot.
        q: joint values [rad or m].

    Raises:
        PoseError: the number of columns of q is not the robot's number of joints.
    """
    _, J = joint_jacobian(robot, q)
    return smallest_singular_value(robot, J)


def smallest_singular_value(
    robot: Robot, J: Float[Tensor, "*batch 6 dof"], nonzero_row_count: int = 6
) -> Float[Tensor, "*batch"]:
    """Return the `singularity_measure` for a given joint Jacobian with the given number of nonzero rows."""
    values: Tensor = torch.linalg.svdvals(dimensionless_jacobian(robot, J).contiguous())
    return values[..., min(nonzero_row_count, robot.dof) - 1]
