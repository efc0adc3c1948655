"""Straight joint motions between poses: check for collisions, and waypoints for blocked motions."""

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings

_MIN_STEP = 1e-3
"""Motion of any point of the robot below which a piece is not divided further [m]; half the clearance if that is
larger."""
_MAX_WAYPOINTS_TRIED = 60
"""Number of poses that are tried as waypoints of a motion; ten times as many pairs of poses are tried."""
BATCH = 20
"""Number of waypoints that are checked together."""
_SAMPLE = 50
"""Number of poses to which motions are checked in order to find which of two poses is harder to leave."""


class Motions:
    """Straight joint motions between poses; every motion is checked only once.

    Attributes:
        arm: the robot in its surroundings.
        pool: joint values of free poses that can be waypoints [rad or m].
    """

    def __init__(self, arm: ArmInSurroundings, pool: Float64[Tensor, "free dof"]) -> None:
        """Start without checked motions."""
        self.arm, self.pool = arm, pool
        self._free: dict[tuple[bytes, bytes], bool] = {}
        self._points: dict[tuple[bytes, bytes], Float64[Tensor, "points dof"] | None] = {}

    def are_free(
        self, start: Float64[Tensor, "motions dof"], end: Float64[Tensor, "motions dof"]
    ) -> Bool[Tensor, " motions"]:
        """Return the mask of motions that are collision-free, in either direction."""
        names = [*map(sorted, zip(_names(start), _names(end), strict=True))]
        pairs = [(one, other) for one, other in names]
        new = torch.tensor([pair not in self._free for pair in pairs], dtype=torch.bool).nonzero()[:, 0]
        free = is_free(self.arm, start[new], end[new])
        self._free |= {pairs[motion]: one for motion, one in zip(new.tolist(), free.tolist(), strict=True)}
        return torch.tensor([self._free[pair] for pair in pairs], dtype=torch.bool)

    def points_between(
        self, start: Float64[Tensor, " dof"], end: Float64[Tensor, " dof"]
    ) -> Float64[Tensor, "points dof"] | None:
        """Return the waypoints of a motion; empty if none are needed, None if none were found."""
        if bool(self.are_free(start[None], end[None])):
            return self.pool[:0]
        (pair,) = zip(_names(start[None]), _names(end[None]), strict=True)
        if pair not in self._points:
            self._points[pair] = waypoints(self.arm, start, end, self.pool)
        return self._points[pair]

    def is_harder_to_leave(self, pose: Float64[Tensor, " dof"], other: Float64[Tensor, " dof"]) -> bool:
        """Return whether fewer free motions lead away from a pose than from another pose."""
        sample = self.pool[:: max(1, len(self.pool) // _SAMPLE)]
        one, two = (int(self.are_free(q.expand_as(sample), sample).sum()) for q in (pose, other))
        return one < two


def is_free(
    arm: ArmInSurroundings, start: Float64[Tensor, "motions dof"], end: Float64[Tensor, "motions dof"]
) -> Bool[Tensor, " motions"]:
    """Return the mask of straight joint motions that are collision-free.

    A piece of a motion is free if the gap at its midpoint is larger than the motion of any point of the robot from
    there to its ends; other pieces are halved (Schwarzer, Saha and Latombe 2005, IEEE Trans. Robotics 21(3), section
    IV).

    Args:
        arm: the robot in its surroundings.
        start: joint values at the start [rad or m].
        end: joint values at the end [rad or m].
    """
    free = torch.ones(len(start), dtype=torch.bool)
    travel = (end - start).abs() @ arm.motion_per_joint_value
    finest = max(_MIN_STEP, arm.surroundings.clearance / 2)
    motion, middle, half = torch.arange(len(start)), torch.full((len(start),), 0.5), 0.5
    middle = middle.double()
    while len(motion):
        q = start[motion] + middle[:, None] * (end[motion] - start[motion])
        gap, moved = arm.smallest_clearance(q), half * travel[motion]
        free[motion[gap < 0]] = False
        open_ = free[motion] & (gap < moved) & (moved > finest)
        motion, middle, half = motion[open_].repeat(2), middle[open_], half / 2
        middle = torch.cat([middle - half, middle + half])
    return free


def waypoints(
    arm: ArmInSurroundings,
    start: Float64[Tensor, " dof"],
    end: Float64[Tensor, " dof"],
    pool: Float64[Tensor, "poses dof"],
) -> Float64[Tensor, "points dof"] | None:
    """Find one or two waypoints that make a motion collision-free, on the shortest of the paths tried.

    Args:
        arm: the robot in its surroundings.
        start: joint values at the start [rad or m].
        end: joint values at the end [rad or m].
        pool: joint values of free poses that can be waypoints [rad or m].

    Returns:
        Joint values of the waypoints [rad or m]; None if no path was found.
    """
    to, back = _travel(arm, start, pool), _travel(arm, pool, end)
    tried = (to + back).argsort()[:_MAX_WAYPOINTS_TRIED]
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
    shortest = length.argsort()[: 10 * _MAX_WAYPOINTS_TRIED]
    for some in torch.split(shortest, BATCH):
        free = is_free(arm, pool[first[some]], pool[second[some]])
        if bool(free.any()):
            best = some[int(free.int().argmax())]
            return torch.stack([pool[first[best]], pool[second[best]]])
    return None


def _travel(arm: ArmInSurroundings, start: Tensor, end: Tensor) -> Float64[Tensor, " poses"]:
    """Compute the largest motion of any point of the robot [m]."""
    length: Tensor = (end - start).abs() @ arm.motion_per_joint_value
    return length


def _names(poses: Float64[Tensor, "poses dof"]) -> list[bytes]:
    """Return the bytes of the joint values of poses, as dictionary keys."""
    return [pose.tobytes() for pose in poses.contiguous().numpy()]
