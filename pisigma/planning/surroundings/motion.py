"""Straight joint motions between poses: check for collisions, and waypoints for blocked motions."""

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings

_MIN_STEP = 1e-3
"""Motion of any point of the robot below which a piece is not divided further [m]; half the clearance if that is
larger."""
_MAX_WAYPOINTS_TRIED = 60
"""Number of poses that are tried as the only waypoint of a motion, and number of nodes of the roadmap."""
BATCH = 20
"""Number of waypoints that are checked together."""
_NEAREST = 3
"""Number of nodes of the roadmap to which motions from a pose are tried."""
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
            self._points[pair] = self._waypoints(start, end)
        return self._points[pair]

    def _waypoints(
        self, start: Float64[Tensor, " dof"], end: Float64[Tensor, " dof"]
    ) -> Float64[Tensor, "points dof"] | None:
        """Return a pose of the pool with a short detour, or else the shortest path on the roadmap; None without any."""
        detour = _travel(self.arm, start, self.pool) + _travel(self.arm, self.pool, end)
        for tried in torch.split(detour.argsort()[:_MAX_WAYPOINTS_TRIED], BATCH):
            points = self.pool[tried]
            points = points[is_free(self.arm, start.expand_as(points), points)]
            points = points[is_free(self.arm, points, end.expand_as(points))]
            if len(points):
                return points[:1]
        nodes, lengths = self._roadmap
        ends = np.stack([_lengths(self.arm, pose.expand_as(nodes), nodes) for pose in (start, end)])
        graph = np.block([[lengths, ends.T], [ends, np.full((2, 2), np.inf)]])
        _, previous = dijkstra(graph, directed=False, indices=len(nodes), return_predecessors=True)
        path: list[int] = []
        node = int(previous[-1])
        while 0 <= node < len(nodes):
            path.insert(0, node)
            node = int(previous[node])
        return nodes[path] if path else None

    @cached_property
    def _roadmap(self) -> tuple[Float64[Tensor, "nodes dof"], Float64[np.ndarray, "nodes nodes"]]:
        """Probabilistic roadmap: some poses of the pool, and lengths of the free motions between them [m].

        Blocked motions have the length inf (Kavraki, Svestka, Latombe and Overmars 1996, IEEE Trans. Robotics and
        Automation 12(4)).
        """
        nodes = self.pool[:: max(1, len(self.pool) // _MAX_WAYPOINTS_TRIED)]
        first, second = torch.triu_indices(len(nodes), len(nodes), 1)
        lengths = np.full((len(nodes), len(nodes)), np.inf)
        lengths[first, second] = lengths[second, first] = _lengths(self.arm, nodes[first], nodes[second])
        return nodes, lengths

    def reach_most_of_task(
        self, poses: Float64[Tensor, "poses dof"], task: Float64[Tensor, "tasks dof"]
    ) -> Bool[Tensor, " poses"]:
        """Return the mask of poses with a free motion to the connected part of the roadmap that most of a task reaches.

        Free poses can form parts without motions between them, such as those on both sides of a collision of the
        gripper with the forearm.

        Args:
            poses: joint values [rad or m].
            task: joint values at which the robot must be accurate [rad or m].
        """
        nodes, lengths = self._roadmap
        number = connected_components(np.isfinite(lengths), directed=False)[1]
        parts = [nodes[number == part] for part in np.unique(number)]
        return self._reach(poses, max(parts, key=lambda part: int(self._reach(task, part).sum())))

    def _reach(
        self, poses: Float64[Tensor, "poses dof"], nodes: Float64[Tensor, "nodes dof"]
    ) -> Bool[Tensor, " poses"]:
        """Return the mask of poses with a free motion to one of the nearest nodes."""
        nearest = torch.stack([_travel(self.arm, poses, node) for node in nodes], 1).argsort(1)
        reached = torch.zeros(len(poses), dtype=torch.bool)
        for node in nearest.unbind(1)[:_NEAREST]:
            reached[~reached] = is_free(self.arm, poses[~reached], nodes[node[~reached]])
        return reached

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


def _lengths(
    arm: ArmInSurroundings, start: Float64[Tensor, "motions dof"], end: Float64[Tensor, "motions dof"]
) -> Float64[np.ndarray, " motions"]:
    """Return the lengths of motions [m]; inf for blocked ones."""
    return np.where(is_free(arm, start, end), _travel(arm, start, end), np.inf)


def _travel(arm: ArmInSurroundings, start: Tensor, end: Tensor) -> Float64[Tensor, " poses"]:
    """Compute the largest motion of any point of the robot [m]."""
    length: Tensor = (end - start).abs() @ arm.motion_per_joint_value
    return length


def _names(poses: Float64[Tensor, "poses dof"]) -> list[bytes]:
    """Return the bytes of the joint values of poses, as dictionary keys."""
    return [pose.tobytes() for pose in poses.contiguous().numpy()]
