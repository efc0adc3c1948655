"""Equations of touches: the tips of two arms are at one point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.shared_objects import TOUCH, ArmPosterior, SharedObject
from pisigma.files.errors import IdentificationError
from pisigma.robot.se3 import skew

Tip = tuple[int, str]
"""Index of an arm, and name of a tip whose position on its last row is unknown."""


@dataclass(frozen=True, eq=False)
class TipPositions:
    """Touching tips of an arm in its base, one row per touch.

    Attributes:
        position: positions [m].
        position_derivatives: derivatives along the directions of the arm's root.
        rotation: rotation of the last row, by which an unknown tip moves with its coordinates.
    """

    position: Float64[Tensor, "touches 3"]
    position_derivatives: Float64[Tensor, "touches 3 directions"]
    rotation: Float64[Tensor, "touches 3 3"]


def initial_tips(arms: Sequence[ArmPosterior]) -> dict[Tip, Float64[Tensor, " 3"]]:
    """Return a start value for every unknown tip: the position of the arm's first target [m]."""
    return {
        (number, tip): torch.from_numpy(next(iter(arm.uncertainty.geometry.tools.values()))[:3].copy())
        for number, arm in enumerate(arms)
        for tip in arm.unknown_tips
    }


def check_touches(arms: Sequence[ArmPosterior]) -> None:
    """Check that every touch is one row of each of two arms.

    Raises:
        IdentificationError: a touch has another number of rows or arms.
    """
    names = [(name, arm.name) for arm in arms if arm.touches for name in arm.touches.names]
    for touch in dict.fromkeys(name for name, _ in names):
        touching = [arm for name, arm in names if name == touch]
        if len(touching) != 2 or touching[0] == touching[1]:
            raise IdentificationError(
                expected=f"one row of each of two arms with touch '{touch}'",
                value=touching,
                option="touches",
                remedy="state the same name in the column 'socket' in the rows of both arms",
            )


def tip_positions(
    arms: Sequence[ArmPosterior], tips: dict[Tip, Float64[Tensor, " 3"]]
) -> list[TipPositions | None]:
    """Return the touching tips of every arm, linearised at its fit; None for an arm without touches."""
    return [_of_arm(number, arm, tips) if arm.touches else None for number, arm in enumerate(arms)]


def _of_arm(number: int, arm: ArmPosterior, tips: dict[Tip, Tensor]) -> TipPositions:
    touches, root = arm.touches, arm.covariance_root
    assert touches is not None
    count = len(touches.names)
    position, turned = root.new_empty(count, 3), root.new_empty(count, 3, 3)
    directions = root.new_empty(count, 3, root.shape[1])
    for tip in dict.fromkeys(touches.tips):
        chosen = torch.tensor([one == tip for one in touches.tips])
        T, columns = arm.tool_poses_in_base(touches.postures[chosen], tip, tips.get((number, tip)))
        position[chosen], turned[chosen], directions[chosen] = T[:, :3, 3], T[:, :3, :3], columns @ root
    return TipPositions(position, directions, turned)


def touch_equations(
    arms: Sequence[ArmPosterior],
    touches: Sequence[SharedObject],
    T: Float64[Tensor, "arms 4 4"],
    tips: dict[Tip, Float64[Tensor, " 3"]],
    z: Sequence[Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return derivatives of the equations of all touches with respect to z and x, and their values.

    An equation is the position of the second tip minus that of the first one, in the base of the first arm [m]. They
    are linearised at the fits of the arms, whose errors are small, and at the current bases and tips.

    Args:
        arms: the arms.
        touches: the touches.
        T: current bases; x begins with the shifts and rotations of all but the first of them.
        tips: current positions of the unknown tips; x ends with their changes [m].
        z: current directions of the roots of all arms.
    """
    there = tip_positions(arms, tips)
    sizes = [len(one) for one in z]
    B = T.new_zeros(len(touches), 3, sum(sizes))
    G = T.new_zeros(len(touches), 3, 6 * (len(arms) - 1) + 3 * len(tips))
    closed = T.new_zeros(len(touches), 3)
    for k, one in enumerate(touches):
        for sign, number in zip((-1.0, 1.0), one.arms, strict=True):
            rows, at = arms[number].touches, there[number]
            assert rows is not None
            assert at is not None
            row, R = rows.names.index(one.name), T[number, :3, :3]
            first = sum(sizes[:number])
            B[k, :, first : first + sizes[number]] = sign * R @ at.position_derivatives[row]
            away = R @ at.position[row]
            closed[k] += sign * (T[number, :3, 3] + away + R @ at.position_derivatives[row] @ z[number])
            if number:
                G[k, :, 6 * number - 6 : 6 * number] = sign * torch.cat([torch.eye(3).to(T), -skew(away)], 1)
            if (number, rows.tips[row]) in tips:
                place = 6 * (len(arms) - 1) + 3 * list(tips).index((number, rows.tips[row]))
                G[k, :, place : place + 3] = sign * R @ at.rotation[row]
    return B.flatten(0, 1), G.flatten(0, 1), closed.flatten()


def touch_sigmas(arms: Sequence[ArmPosterior], touches: Sequence[SharedObject]) -> Iterator[float]:
    """Yield the standard deviation of every touch along an axis, from those of its two rows [m]."""
    for one in touches:
        assert one.kind == TOUCH
        rows = [touched for number in one.arms if (touched := arms[number].touches) is not None]
        yield sum(float(own.sigma[own.names.index(one.name)]) ** 2 for own in rows) ** 0.5
