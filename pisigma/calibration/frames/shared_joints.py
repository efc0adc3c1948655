"""Joints of a torso that several arms share: equations of their axes, and one set of parameters for all arms."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import takewhile

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.shared_objects import ArmPosterior
from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.calibration.geometric.problem.setup import IdentifiedGeometry
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.robot.frame_fits import moved_frame
from pisigma.robot.kinematics.components import (
    IDENTITY,
    as_transform,
    rotate_x,
    rotate_y,
    rotate_z,
    translate,
)
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform


def frame_after_rows(dh: Float64[Tensor, " parameters"]) -> Float64[Tensor, "4 4"]:
    """Return the frame after rows of a robot at joint values 0, in its base; its z axis is that of the next joint."""
    frame = IDENTITY
    for theta, d, a, alpha, beta in dh.view(-1, 5):
        moved = translate(rotate_z(frame, theta), a, 0.0, d)
        frame = rotate_y(rotate_x(moved, alpha), beta)
    return as_transform(frame, like=dh.new_zeros(()))


def axis_difference(
    axis: Float64[Tensor, "4 4"], other: Float64[Tensor, "4 4"], is_revolute: bool
) -> Float64[Tensor, " _equations"]:
    """Return the differences of two joint axes: of their directions and, unless they are prismatic, their positions.

    Args:
        axis: a frame whose z axis is one axis.
        other: a frame whose z axis is the other axis.
        is_revolute: whether the joint turns about the axis; only the direction matters for a prismatic joint.
    """
    across = axis[:3, :2].mT
    turned = across @ other[:3, 2]
    return torch.cat([turned, across @ (other[:3, 3] - axis[:3, 3])]) if is_revolute else turned


def with_common_joints(
    arm: ArmPosterior,
    reference: ArmPosterior,
    T_first_base: tuple[Float64[Tensor, "4 4"], Float64[Tensor, "4 4"]],
    base_covariance_roots: tuple[Float64[Tensor, "6 directions"], Float64[Tensor, "6 directions"]],
    count: int,
) -> ArmPosterior:
    """Return an arm with the base and the shared rows of another arm, and with unchanged poses of its tool.

    Equal axes leave two directions open: the frame of the last shared joint may be turned about and shifted along its
    axis. The offsets theta and d of this joint, which also contain the error of the branch, take up the difference.

    Args:
        arm: the arm, conditioned on equal axes of the shared joints.
        reference: the arm whose values are taken, conditioned in the same directions.
        T_first_base: bases of the arm and of the reference, in the base of the first arm.
        base_covariance_roots: roots of the covariance of both bases, see `ArmBases.covariance_root`.
        count: number of shared joints.
    """
    shared, own = 5 * (count - 1), len(arm.space.parameters)
    bases = arm.space.indices_of("base")

    def combined(unknowns: Tensor) -> Tensor:
        theirs, values, step, their_step = torch.split(unknowns, [shared, own, 6, 6])
        T_base = moved_frame(T_first_base[0], step)
        T_reference = moved_frame(T_first_base[1], their_step)
        T_new_old = invert(T_reference) @ T_base
        between = invert(frame_after_rows(theirs)) @ T_new_old @ frame_after_rows(values[:shared])
        offsets = values[shared : shared + 2] + torch.stack(
            [torch.atan2(between[1, 0], between[0, 0]), between[2, 3]]
        )
        there = transform_from_xyz_zyx(values[bases.start : bases.stop].view(-1, 6)) @ invert(T_new_old)
        return torch.cat(
            [
                theirs,
                offsets,
                values[shared + 2 : bases.start],
                xyz_zyx_from_transform(there).flatten(),
                values[bases.stop :],
            ]
        )

    at = torch.cat([reference.values[:shared], arm.values, torch.zeros(12).to(arm.values)])
    roots = torch.cat([reference.covariance_root[:shared], arm.covariance_root[:own], *base_covariance_roots])
    return with_values(
        arm, combined(at), torch.cat([torch.func.jacrev(combined)(at) @ roots, arm.covariance_root[own:]])
    )


def with_values(
    arm: ArmPosterior,
    values: Float64[Tensor, " parameters"],
    covariance_root: Float64[Tensor, "unknowns directions"],
) -> ArmPosterior:
    """Return the posterior of an arm with other values and another root."""
    known = replace(
        arm.uncertainty,
        geometry=geometry_at(arm.space, values),
        covariance_root=CovarianceRoot(covariance_root.contiguous()),
    )
    return replace(arm, uncertainty=known)


def geometry_at(space: ParameterSpace, values: Float64[Tensor, " parameters"]) -> IdentifiedGeometry:
    """Return the geometry with given values of all parameters of a space, in the user's coordinates."""
    dh, bases, tools = (block.numpy() for block in space.split(values))
    return IdentifiedGeometry(
        robot=space.robot.with_geometry(dh=dh, base=bases[0], tool=tools[0]),
        bases=dict(zip(space.frames, bases, strict=True)),
        tools=dict(zip(space.targets, tools, strict=True)),
        unknowns={
            own.name: dict(zip(own.owners, columns.t().numpy(), strict=True))
            for own, columns in zip(space.unknowns, space.sensor_unknowns(values).values(), strict=True)
        },
    )


def shared_joint_count(arm: ArmPosterior, other: ArmPosterior) -> int:
    """Return the number of joints of a torso that two arms share."""
    pairs = zip(arm.torso_joints, other.torso_joints, strict=False)
    return sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))


def arms_sharing_most_joints(arms: Sequence[ArmPosterior]) -> list[tuple[int, int]]:
    """Return, for every arm, the earlier arm with which it shares most joints and the number of these joints.

    An arm that shares no joint with an earlier one is its own reference, with 0 joints.
    """
    counts = [
        [shared_joint_count(arm, before) for before in arms[:number]] for number, arm in enumerate(arms)
    ]
    return [(of.index(max(of)), max(of)) if any(of) else (number, 0) for number, of in enumerate(counts)]
