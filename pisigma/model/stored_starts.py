"""Joint values that a model keeps of its training rows, as starts for the numeric inverse."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot.description import Robot

MAXIMUM_STARTS = 512

_CHUNK = 4096
"""Poses whose distances to all starts are computed at once."""


class StoredStarts:
    """Starts and the poses that they take a robot to.

    Attributes:
        robot: the robot.
        q: joint values [rad or m].
        T: the poses T_base_tool there.
    """

    def __init__(self, robot: Robot, q: Float64[Tensor, "starts dof"]) -> None:
        """Compute the poses of the starts."""
        self.robot = robot
        self.q = q
        self.T = forward_kinematics(robot, q)

    def nearest(self, T: Float64[Tensor, "poses 4 4"], count: int) -> Int64[Tensor, "poses _nearest"]:
        """For every pose the indices of the starts whose poses are nearest, nearest first.

        Args:
            T: wanted poses.
            count: how many are wanted; fewer where there are fewer starts.
        """
        count = min(count, len(self.q))
        poses, rows = self._as_points(T), self._as_points(self.T)
        found = [torch.zeros((0, count), dtype=torch.int64)]
        for first in range(0, len(poses), _CHUNK):
            distance = torch.cdist(poses[first : first + _CHUNK], rows)
            found.append(distance.topk(count, largest=False).indices)
        return torch.cat(found)

    def _as_points(self, T: Tensor) -> Tensor:
        """Poses as points; their distance is that of the tools [m], plus half a reach per radian of turn."""
        lever = self.robot.reach / 2 / 2**0.5  # a small turn changes R by sqrt(2) times its angle
        return torch.cat([T[:, :3, 3], lever * T[:, :3, :3].flatten(1)], -1)


def spread_rows(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "starts dof"]:
    """All rows, or as many as are kept, evenly spread over them."""
    return q[torch.linspace(0, len(q) - 1, min(len(q), MAXIMUM_STARTS)).round().long()].clone()
