"""Joint values of training rows that a model stores, as initial values of the numeric inverse."""

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form import AbstractClosedForm
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes

MAX_STARTS = 512

SAME = 1e-6
"""Rounding step [rad or m]: joint values that round to the same multiple are treated as equal."""
_CHUNK = 4096
"""Number of poses whose distances from all starts are computed at a time, which limits the memory."""


class StoredStarts:
    """Initial joint values of the numeric inverse, and the robot's poses at these values.

    Attributes:
        robot: robot to which the joint values belong.
        q: joint values [rad or m].
        T: poses T_base_tool [m] at these joint values.
        lever: half the robot's reach divided by sqrt(2) [m], because a small rotation by φ changes R by sqrt(2) φ.
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
        """Return the indices of the starts with the poses nearest to every pose, nearest first.

        Args:
            T: target poses T_base_tool.
            count: number of starts per pose; fewer are returned if there are not enough.
            axes: axes of the tool that are constrained.
        """
        counted = torch.tensor([True] * 3 + 3 * list(axes.compared_directions))
        count = min(count, len(self.q))
        chunks, points = torch.split(self.as_points(T)[:, counted], _CHUNK), self.points[:, counted]
        nearest = [torch.cdist(chunk, points).topk(count, largest=False).indices for chunk in chunks]
        return torch.cat(nearest)

    def as_points(self, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses 12"]:
        """Return poses as points whose distances combine those of the tools [m] with half the reach per radian."""
        return torch.cat([T[:, :3, 3], self.lever * T[:, :3, :3].flatten(1)], -1)


def middle_of_starts(starts: Float64[Tensor, "starts dof"]) -> Float64[Tensor, " dof"]:
    """Return the middle of the training rows' joint values [rad or m], near which a network's inputs are wrapped."""
    lower, upper = starts.aminmax(dim=0)
    return (lower + upper).double() / 2


def evenly_spaced_rows(q: Float64[Tensor, "rows dof"]) -> Float64[Tensor, "starts dof"]:
    """Return all rows, or `MAX_STARTS` evenly spaced rows if there are more."""
    return q[torch.linspace(0, len(q) - 1, min(len(q), MAX_STARTS)).round().long()].clone()


def nearest_branch(solver: AbstractClosedForm, q: Float64[Tensor, "poses dof"]) -> Int64[Tensor, " poses"]:
    """Return the index of the nominal robot's branch that is nearest to joint values [rad or m]; 0 for NaN."""
    known = torch.isfinite(q).all(-1)
    safe = torch.where(known[:, None], q, 0.0)
    return torch.where(known, solver.nearest(forward_kinematics(solver.robot, safe), safe)[1], 0)


def count_rows_at_starts(starts: Float64[Tensor, "starts dof"], q: Float64[Tensor, "rows dof"]) -> int:
    """Return the number of rows whose joint values [rad or m] are among the values that a model stores."""
    kept = {tuple(row) for row in (starts / SAME).round().tolist()}
    return sum(tuple(row) in kept for row in (q / SAME).round().tolist())
