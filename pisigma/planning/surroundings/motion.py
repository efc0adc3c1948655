"""Motions between poses that go straight in joint values: whether they are free, and way points where they are not."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.planning.surroundings.arm_in_cell import ArmInCell

FINEST = 1e-3
"""[m] Pieces of a motion in which no point of the robot moves farther are not divided, nor those of half the
clearance."""
TRIED = 60
"""Poses that are tried as way points of a motion, and ten times as many pairs of them."""
BATCH = 20
"""Of these are looked at together."""
SAMPLE = 50
"""Poses to which ways are looked for, to tell which of two poses is shut in."""


class Motions:
    """Straight motions of the joints between poses, each of which is looked at once at most.

    Attributes:
        arm: the robot in its cell.
        pool: free poses that way points may be [rad or m].
    """

    def __init__(self, arm: ArmInCell, pool: Float64[Tensor, "free dof"]) -> None:
        """Start with no motion."""
        self.arm, self.pool = arm, pool
        self._free: dict[tuple[bytes, bytes], bool] = {}
        self._points: dict[tuple[bytes, bytes], Float64[Tensor, "points dof"] | None] = {}

    def are_free(
        self, start: Float64[Tensor, "motions dof"], end: Float64[Tensor, "motions dof"]
    ) -> Bool[Tensor, " motions"]:
        """Whether they touch nothing, one way or the other."""
        names = [*map(sorted, zip(_names(start), _names(end), strict=True))]
        pairs = [(one, other) for one, other in names]
        new = torch.tensor([pair not in self._free for pair in pairs], dtype=torch.bool).nonzero()[:, 0]
        free = is_free(self.arm, start[new], end[new])
        self._free |= {pairs[motion]: one for motion, one in zip(new.tolist(), free.tolist(), strict=True)}
        return torch.tensor([self._free[pair] for pair in pairs], dtype=torch.bool)

    def points_between(
        self, start: Float64[Tensor, " dof"], end: Float64[Tensor, " dof"]
    ) -> Float64[Tensor, "points dof"] | None:
        """Way points of a motion, none where it is free as it is; None where no way was found."""
        if bool(self.are_free(start[None], end[None])):
            return self.pool[:0]
        (pair,) = zip(_names(start[None]), _names(end[None]), strict=True)
        if pair not in self._points:
            self._points[pair] = way_points(self.arm, start, end, self.pool)
        return self._points[pair]

    def is_shut_in(self, pose: Float64[Tensor, " dof"], other: Float64[Tensor, " dof"]) -> bool:
        """Whether fewer free motions lead away from a pose than from another one."""
        sample = self.pool[:: max(1, len(self.pool) // SAMPLE)]
        one, two = (int(self.are_free(q.expand_as(sample), sample).sum()) for q in (pose, other))
        return one < two


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
    for some in torch.split(shortest, BATCH):
        free = is_free(arm, pool[first[some]], pool[second[some]])
        if bool(free.any()):
            best = some[int(free.int().argmax())]
            return torch.stack([pool[first[best]], pool[second[best]]])
    return None


def _travel(arm: ArmInCell, start: Tensor, end: Tensor) -> Float64[Tensor, " poses"]:
    """How far points of the robot move at most [m]."""
    length: Tensor = (end - start).abs() @ arm.lever
    return length


def _names(poses: Float64[Tensor, "poses dof"]) -> list[bytes]:
    """What tells poses apart: the bytes of their joint values."""
    return [pose.tobytes() for pose in poses.contiguous().numpy()]
