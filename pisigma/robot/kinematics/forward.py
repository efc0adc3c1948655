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
    follow_xyzrpy,
    product,
    rotate_x,
    rotate_y,
    rotate_z,
    translate,
)

CHUNK = 16_384
"""Poses worked on together: few enough that the components stay in the processor's cache."""


@dataclass(frozen=True)
class Geometry:
    """Geometric parameters ready for computing: floats of a robot, or tensors to differentiate by.

    Attributes:
        dh: for every row theta [rad], d [m], a [m], alpha [rad], beta [rad].
        base: x, y, z [m], roll, pitch, yaw [rad].
        tool: the same for the tool.
    """

    dh: Sequence[Sequence[Scalar]]
    base: Sequence[Scalar]
    tool: Sequence[Scalar]

    @staticmethod
    def of(robot: Robot) -> "Geometry":
        """The geometry of a robot as plain floats."""
        return Geometry(robot.dh.tolist(), robot.base.tolist(), robot.tool.tolist())

    @staticmethod
    def from_tensors(
        dh: Float[Tensor, "rows 5"], base: Float[Tensor, " 6"], tool: Float[Tensor, " 6"]
    ) -> "Geometry":
        """A geometry that gradients flow through."""
        return Geometry([tuple(row.unbind()) for row in dh.unbind()], base.unbind(), tool.unbind())


@dataclass(frozen=True)
class RowFrames:
    """Where row i stands in the base frame.

    Attributes:
        before: frame before the row; its z axis is the joint's axis.
        turned: after RotZ(theta + q); its x axis is the common normal.
        moved: after Trans(a, 0, d) too.
        twisted: after RotX(alpha) too; its y axis is Hayati's.
        after: after RotY(beta) too, so the next row's `before`.
    """

    before: Frame
    turned: Frame
    moved: Frame
    twisted: Frame
    after: Frame


def iterate_rows(robot: Robot, geometry: Geometry, q: Sequence[Scalar]) -> Iterator[RowFrames]:
    """Walk from the base to the last row (without the tool).

    Args:
        robot: says which rows move, and how.
        geometry: the parameters to use, of the same rows.
        q: one joint value [rad or m] per joint, each a tensor with the batch shape.
    """
    values = iter(q)
    frame = follow_xyzrpy(IDENTITY, geometry.base)
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
    """Tool pose of a robot: `base · Π RotZ(theta + q) Trans(a, 0, d) RotX(alpha) RotY(beta) · tool`.

    Source: Denavit and Hartenberg 1955 with the term of Hayati and Mirmirani 1985; a prismatic joint adds q
    to d. Gradients flow to q and to the tensors of a geometry, in reverse and in forward mode.

    Args:
        robot: the robot.
        q: joint values [rad or m], as the controller counts.
        geometry: other parameters for the same rows, such as tensors to differentiate by.

    Returns:
        T_base_tool, contiguous, with q's dtype and device.

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    robot.check_joint_count(q.shape[-1])
    geometry = geometry or Geometry.of(robot)
    chunks = [_forward_chunk(robot, geometry, chunk).contiguous() for chunk in iterate_chunks(q)]
    T = torch.cat(chunks) if len(chunks) > 1 else chunks[0]
    return T.reshape(*q.shape[:-1], 4, 4)


def iterate_chunks(q: Float[Tensor, "*batch dof"]) -> Iterator[Float[Tensor, "poses dof"]]:
    """The poses in a row, `CHUNK` at a time; one empty chunk where there are none."""
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
    return as_transform(follow_xyzrpy(frame, geometry.tool), like=columns[0])
