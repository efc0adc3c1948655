"""Newton iterations of a calibrated arm towards poses, in torch, in the constrained axes of the tool."""

from dataclasses import dataclass
from functools import cached_property, partial

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.model.calibrated_model import hybrid_motion
from pisigma.robot.description import Robot
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.jacobian import joint_jacobian, smallest_singular_value
from pisigma.robot.kinematics.joint_limits import nearest_turn, wrap_into_limits, wrapped_difference
from pisigma.robot.kinematics.numeric import (
    Motion,
    TaskMotion,
    approach_preferred,
    solve_numeric,
    solve_within_tolerances,
)
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes

_EXACT_ITERATIONS = 25
"""Number of steps with the slope of the correction, after steps without it have come near a pose without converging."""


@dataclass(frozen=True, eq=False)
class NumericArm:
    """An arm with identified geometry and joint correction.

    Attributes:
        nominal: nominal arm, which states the joint limits.
        robot: arm with the identified geometry; for a hybrid, the geometry that belongs to the correction.
        hybrid: arm with joint correction, or None.
        axes: axes of the tool that are constrained.
    """

    nominal: Robot
    robot: Robot
    hybrid: HybridArm | None
    axes: TaskAxes

    @cached_property
    def weights(self) -> tuple[float, ...]:
        """Weights of the axes in least squares."""
        return self.axes.weights(self.robot.dof)

    @cached_property
    def has_spare_joints(self) -> bool:
        """Whether the arm has more joints than constrained axes."""
        return sum(self.weights) < self.robot.dof

    @cached_property
    def motion_functions(self) -> tuple[Motion, ...]:
        """Functions for pose and Jacobian, without the slope of the correction and, for a hybrid, also with it."""
        if self.hybrid is None:
            return (partial(joint_jacobian, self.robot),)
        return tuple(partial(hybrid_motion, self.hybrid, exact=exact) for exact in (False, True))

    def within_reach(self, T: Float64[Tensor, "*batch 4 4"]) -> Bool[Tensor, "*batch"]:
        """Return whether poses T_base_tool are within the arm's length; True if the position is not constrained."""
        if any(self.axes.free[:3]):
            return torch.ones_like(T[..., 0, 0], dtype=torch.bool)
        distance: Tensor = (T[..., :3, 3] - T.new_tensor(self.robot.base[:3].tolist())).norm(dim=-1)
        return distance <= self.robot.reach * (1 + tolerances.REACH_ROUNDING)

    def reach(
        self, T: Float64[Tensor, "poses 4 4"], start: Float64[Tensor, "poses dof"]
    ) -> tuple[Float64[Tensor, "poses dof"], Bool[Tensor, " poses"]]:
        """Iterate from a start for every pose; return joint values [rad or m] and whether they reach the pose.

        The joint values are wrapped near the starts. Poses that cannot be reached exactly are solved within the
        tolerances of the axes.
        """
        # The first Jacobian neglects the derivative of the correction, which is sufficient for most poses and
        # cheaper; # the exact Jacobian is used for poses that came near.
        q, reached = start, torch.zeros(len(T), dtype=torch.bool)
        near, rounds = ~reached, tolerances.MAX_ITERATIONS
        for motion in self.motion_functions:
            rows = (near & ~reached).nonzero()[:, 0]
            found = solve_numeric(
                self.robot,
                T[rows],
                q[rows],
                tolerance=tolerances.TOLERANCE if self.hybrid is None else tolerances.HYBRID_TOLERANCE,
                max_iterations=rounds,
                motion=motion,
                axes=self.axes,
                weights=self.weights,
            )
            q = q.index_copy(0, rows, found.q)
            reached = reached.index_copy(0, rows, found.status != Status.NOT_CONVERGED)
            close = (found.position_residual < tolerances.NEAR_MISS * self.robot.reach) & (
                found.rotation_residual < tolerances.NEAR_MISS
            )
            near, rounds = near.index_copy(0, rows, close), _EXACT_ITERATIONS
        rows = (~reached).nonzero()[:, 0]
        if len(rows) and self.axes.has_tolerances and self.axes.tolerance.count(0.0) < self.robot.dof:
            better, met = solve_within_tolerances(
                self.robot, T[rows], start[rows], self.motion_functions[-1], self.axes
            )
            q, reached = q.index_copy(0, rows, better), reached.index_copy(0, rows, met)
        return start + wrapped_difference(self.nominal, q, start), reached

    def with_redundancy_resolved(
        self,
        T: Float64[Tensor, "poses 4 4"],
        q: Float64[Tensor, "poses dof"],
        near: Float64[Tensor, "poses dof"] | None,
    ) -> Float64[Tensor, "poses dof"]:
        """Move redundant joints, at constant poses, as near as possible to `near` or to the middle of their limits.

        A joint without limits prefers its current value instead, with half a turn as its scale.
        """
        limits, half = self._travel
        q, _ = wrap_into_limits(self.nominal, q)
        if near is None:
            limited = torch.isfinite(half)
            preferred = torch.where(limited, limits.mean(-1), q)
            return approach_preferred(
                self.nominal, self._task, T, q, preferred, torch.where(limited, half, torch.pi)
            )
        q = nearest_turn(self.nominal, q, near, within_limits=True)
        return approach_preferred(self.nominal, self._task, T, q, near, torch.ones_like(half))

    def posture_rating(
        self, T: Float64[Tensor, "poses 4 4"], q: Float64[Tensor, "poses dof"]
    ) -> Float64[Tensor, " poses"]:
        """Return a rating of joint values: singularity measure times relative distance from the nearest joint limit."""
        limits, half = self._travel
        margins = torch.minimum(q - limits[:, 0], limits[:, 1] - q) / half
        margin = torch.where(torch.isfinite(half), margins.clamp(max=1.0), 1.0).amin(-1)
        return margin * self.singularity_measure(T, q)

    def singularity_measure(
        self, T: Float64[Tensor, "poses 4 4"], q: Float64[Tensor, "poses dof"]
    ) -> Float64[Tensor, " poses"]:
        """Compute the smallest singular value of the dimensionless Jacobian in the constrained axes."""
        _, J = self._task.errors(T, q)
        return smallest_singular_value(self.robot, J, self._task.rows)

    @cached_property
    def _task(self) -> TaskMotion:
        weights = torch.tensor(self.weights, dtype=torch.float64)
        return TaskMotion(self.motion_functions[0], self.axes, weights)

    @cached_property
    def _travel(self) -> tuple[Tensor, Tensor]:
        """Joint limits and half the range between them [rad or m]."""
        limits = torch.from_numpy(self.nominal.limits)
        return limits, ((limits[:, 1] - limits[:, 0]) / 2).clamp(min=1e-9)
