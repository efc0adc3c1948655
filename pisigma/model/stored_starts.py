"""Joint values that a model keeps of its training rows: starts of the numeric inverse, and their branches."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes

MAXIMUM_STARTS = 512

SAME = 1e-6
"""[rad or m] Joint values that are rounded to the same multiple of this are the same."""
_CHUNK = 4096
"""Poses whose distances to all starts are computed at once."""


class StoredStarts:
    """Starts and the poses that they take a robot to.

    Attributes:
        robot: the robot.
        q: joint values [rad or m].
        T: the poses T_base_tool there.
        lever: half the robot's reach over sqrt(2) [m]: a small turn changes R by sqrt(2) times its angle.
        points: `(starts, 12)`: the poses as points, see `as_points`.
    """

    def __init__(self, robot: Robot, q: Float64[Tensor, "starts dof"]) -> None:
        """Compute the poses of the starts."""
        self.robot = robot
        self.q = q
        self.T = forward_kinematics(robot, q)
        self.lever = robot.reach / 2 / 2**0.5
        self.points = self.as_points(self.T)

    def nearest(
        self, T: Float64[Tensor, "poses 4 4"], count: int, axes: TaskAxes = WHOLE
    ) -> Int64[Tensor, "poses _nearest"]:
        """For every pose the indices of the starts whose poses are nearest, nearest first.

        Args:
            T: wanted poses.
            count: how many are wanted; fewer where there are fewer starts.
            axes: which axes of the tool count.
        """
        counted = torch.tensor([True] * 3 + 3 * list(axes.directions))
        count = min(count, len(self.q))
        chunks, points = torch.split(self.as_points(T)[:, counted], _CHUNK), self.points[:, counted]
        nearest = [torch.cdist(chunk, points).topk(count, largest=False).indices for chunk in chunks]
        return torch.cat(nearest)

    def as_points(self, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses 12"]:
        """Poses as points; their distance is that of the tools [m], plus half a reach per radian of turn."""
        return torch.cat([T[:, :3, 3], self.lever * T[:, :3, :3].flatten(1)], -1)


def middle_of_starts(starts: Float64[Tensor, "starts dof"]) -> Float64[Tensor, " dof"]:
    """Middle of the joint values [rad or m] of training rows, on whose turns a network knows joint values."""
    lower, upper = starts.aminmax(dim=0)
    return (lower + upper).double() / 2


def spread_rows(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "starts dof"]:
    """All rows, or as many as are kept, evenly spread over them."""
    return q[torch.linspace(0, len(q) - 1, min(len(q), MAXIMUM_STARTS)).round().long()].clone()


def nearest_branch(solver: AbstractClosedForm, q: Float64[Tensor, "poses dof"]) -> Int64[Tensor, " poses"]:
    """Index of the nominal robot's branch whose joint values are nearest to others [rad or m]; 0 for NaN."""
    known = torch.isfinite(q).all(-1)
    safe = torch.where(known[:, None], q, 0.0)
    return torch.where(known, solver.nearest(forward_kinematics(solver.robot, safe), safe)[1], 0)


def rows_at_starts(starts: Float64[Tensor, "starts dof"], q: Float64[Tensor, "rows dof"]) -> int:
    """Count the rows whose joint values [rad or m] are among those that a model keeps."""
    kept = {tuple(row) for row in (starts / SAME).round().tolist()}
    return sum(tuple(row) in kept for row in (q / SAME).round().tolist())
