"""Forward kinematics, batched, for revolute and prismatic joints."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.components import (
    IDENTITY,
    Frame,
    Scalar,
    add,
    as_transform,
    compose_xyz_zyx,
    product,
    rotate_x,
    rotate_y,
    rotate_z,
    translate,
)

CHUNK = 16_384
"""Number of poses that are processed together, so that the components stay in the processor's cache."""


@dataclass(frozen=True)
class Geometry:
    """Geometric parameters of a robot, as floats, or as tensors for derivatives.

    Attributes:
        dh: theta [rad], d [m], a [m], alpha [rad], beta [rad] of every row.
        base: x, y, z [m], roll, pitch, yaw [rad] of the base.
        tool: x, y, z [m], roll, pitch, yaw [rad] of the tool.
    """

    dh: Sequence[Sequence[Scalar]]
    base: Sequence[Scalar]
    tool: Sequence[Scalar]

    @staticmethod
    def from_robot(robot: Robot) -> "Geometry":
        """Return the geometry of a robot as plain floats."""
        return Geometry(robot.dh.tolist(), robot.base.tolist(), robot.tool.tolist())

    @staticmethod
    def from_tensors(
        dh: Float[Tensor, "rows 5"], base: Float[Tensor, " 6"], tool: Float[Tensor, " 6"]
    ) -> "Geometry":
        """Return the geometry of tensors, through which gradients flow."""
        return Geometry([tuple(row.unbind()) for row in dh.unbind()], base.unbind(), tool.unbind())


@dataclass(frozen=True)
class RowFrames:
    """Intermediate frames of a DH row, in the base frame.

    Attributes:
        before: frame before the row; its z axis is the joint's axis.
        after_theta: frame after RotZ(theta + q); its x axis is the common normal.
        after_translation: frame after RotZ and Trans(a, 0, d).
        after_alpha: frame after RotZ, Trans and RotX(alpha); beta rotates about its y axis.
        after: frame after the whole row, which is `before` of the next row.
    """

    before: Frame
    after_theta: Frame
    after_translation: Frame
    after_alpha: Frame
    after: Frame


def iterate_rows(robot: Robot, geometry: Geometry, q: Sequence[Scalar]) -> Iterator[RowFrames]:
    """Yield the frames of the rows from the base to the last one, without the tool.

    Args:
        robot: robot with the types and directions of the rows.
        geometry: parameters of the rows.
        q: one joint value [rad or m] per joint, each a tensor of the batch shape.
    """
    values = iter(q)
    frame = compose_xyz_zyx(IDENTITY, geometry.base)
    for row, (theta, d, a, alpha, beta) in zip(robot.rows, geometry.dh, strict=True):
        if row.type != "fixed":
            joint = product(float(row.direction), next(values))
            theta, d = (add(joint, theta), d) if row.type == "revolute" else (theta, add(joint, d))
        turned = rotate_z(frame, theta)
        moved = translate(turned, a, 0.0, d)
        twisted = rotate_x(moved, alpha)
        after = rotate_y(twisted, beta)
        yield RowFrames(frame, turned, moved, twisted, after)
        frame = after


def forward_kinematics(
    robot: Robot, q: Float[Tensor, "*batch dof"], geometry: Geometry | None = None
) -> Float[Tensor, "*batch 4 4"]:
    """Compute the tool pose `base · Π RotZ(theta + q) Trans(a, 0, d) RotX(alpha) RotY(beta) · tool`.

    Source: Denavit and Hartenberg 1955 with the term of Hayati and Mirmirani 1985; a prismatic joint adds q
    to d. Gradients flow to q and to the tensors of a geometry, in reverse and in forward mode.

    Args:
        robot: the robot.
        q: joint values [rad or m].
        geometry: geometric parameters to use instead of the robot's, such as tensors for derivatives.

    Returns:
        T_base_tool, contiguous, with the dtype and device of q.

    Raises:
        PoseError: the number of columns of q is not the number of joints.
    """
    robot.check_joint_count(q.shape[-1])
    geometry = geometry or Geometry.from_robot(robot)
    chunks = [_forward_chunk(robot, geometry, chunk).contiguous() for chunk in iterate_chunks(q)]
    T = torch.cat(chunks) if len(chunks) > 1 else chunks[0]
    return T.reshape(*q.shape[:-1], 4, 4)


def iterate_chunks(q: Float[Tensor, "*batch dof"]) -> Iterator[Float[Tensor, "poses dof"]]:
    """Yield the flattened batch in chunks of `CHUNK` poses; an empty batch gives one empty chunk."""
    flat = q.reshape(-1, q.shape[-1])
    for start in range(0, max(flat.shape[0], 1), CHUNK):
        yield flat[start : start + CHUNK]


def _forward_chunk(
    robot: Robot, geometry: Geometry, q: Float[Tensor, "poses dof"]
) -> Float[Tensor, "poses 4 4"]:
    columns = q.t().contiguous().unbind(0)
    frame = IDENTITY
    for row in iterate_rows(robot, geometry, columns):
        frame = row.after
    return as_transform(compose_xyz_zyx(frame, geometry.tool), like=columns[0])
