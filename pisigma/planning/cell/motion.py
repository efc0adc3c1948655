"""Motions between poses that go straight in joint values: whether they are free, and way points where they are not."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.planning.cell.arm_in_cell import ArmInCell

FINEST = 1e-3
"""[m] Pieces of a motion in which no point of the robot moves farther are not divided, nor those of half the
clearance."""
TRIED = 60
"""Poses that are tried as way points of a motion, and ten times as many pairs of them."""
BATCH = 20
"""Of these are looked at together."""


def is_free(
    arm: ArmInCell, start: Float64[Tensor, "motions dof"], end: Float64[Tensor, "motions dof"]
) -> Bool[Tensor, " motions"]:
    """Say which straight motions of the joints touch nothing.

    A piece of a motion is free where there is more room at its middle than any point of the robot can move from there
    to its ends; other pieces are halved (Schwarzer, Saha and Latombe 2005, IEEE Trans. Robotics 21(3), section IV).

    Args:
        arm: the robot in its cell.
        start: joint values [rad or m].
        end: likewise.
    """
    free = torch.ones(len(start), dtype=torch.bool)
    travel = (end - start).abs() @ arm.lever
    finest = max(FINEST, arm.cell.clearance / 2)
    motion, middle, half = torch.arange(len(start)), torch.full((len(start),), 0.5), 0.5
    middle = middle.double()
    while len(motion):
        q = start[motion] + middle[:, None] * (end[motion] - start[motion])
        gap, moved = arm.gap(q), half * travel[motion]
        free[motion[gap < 0]] = False
        open_ = free[motion] & (gap < moved) & (moved > finest)
        motion, middle, half = motion[open_].repeat(2), middle[open_], half / 2
        middle = torch.cat([middle - half, middle + half])
    return free


def way_points(
    arm: ArmInCell,
    start: Float64[Tensor, " dof"],
    end: Float64[Tensor, " dof"],
    pool: Float64[Tensor, "poses dof"],
) -> Float64[Tensor, "points dof"] | None:
    """Find one or two poses by way of which a motion is free; the shortest way among those that are tried.

    Args:
        arm: the robot in its cell.
        start: joint values [rad or m].
        end: likewise.
        pool: free poses to go by.

    Returns:
        The joint values of the poses in between [rad or m]; None where no way was found.
    """
    to, back = _travel(arm, start, pool), _travel(arm, pool, end)
    tried = (to + back).argsort()[:TRIED]
    pool, to, back = pool[tried], to[tried], back[tried]
    reached, left = torch.zeros(2, len(pool), dtype=torch.bool)
    for some in torch.split(torch.arange(len(pool)), BATCH):
        reached[some] = is_free(arm, start.expand_as(pool[some]), pool[some])
        left[some] = is_free(arm, pool[some], end.expand_as(pool[some]))
        if bool((reached & left).any()):
            return pool[reached & left][:1]
    first, second = reached.nonzero()[:, 0], left.nonzero()[:, 0]
    if not len(first) or not len(second):
        return None
    first, second = torch.cartesian_prod(first, second).unbind(-1)
    length = to[first] + _travel(arm, pool[first], pool[second]) + back[second]
    shortest = length.argsort()[: 10 * TRIED]
    first, second = first[shortest], second[shortest]
    free = is_free(arm, pool[first], pool[second])
    if not bool(free.any()):
        return None
    best = int(free.int().argmax())
    return torch.stack([pool[first[best]], pool[second[best]]])


def _travel(arm: ArmInCell, start: Tensor, end: Tensor) -> Float64[Tensor, " poses"]:
    """How far points of the robot move at most [m]."""
    length: Tensor = (end - start).abs() @ arm.lever
    return length
