"""Inverse kinematics of an identified geometry, which has no closed form of its own."""

import math
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.model.hybrid_motion import hybrid_motion
from pisigma.model.stored_starts import StoredStarts, nearest_branch
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.closed_form.interface import AbstractClosedForm
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.joint_limits import wrapped_difference
from pisigma.robot.kinematics.numeric import NumericSolution, solve_numeric
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes
from pisigma.robot.kinematics.task_error import task_error
from pisigma.robot.kinematics.tolerances import (
    ATTEMPTS,
    BESIDE,
    HYBRID_TOLERANCE,
    ITERATIONS,
    NEARLY,
    REACH_ROUNDING,
)
from pisigma.robot.se3 import invert, transform

CHEAP_ITERATIONS, EXACT_ITERATIONS = 10, 25
"""Steps of a hybrid arm with the cheap Jacobian, and after these with the exact one."""


def within_reach(robot: Robot, T: Float64[Tensor, "*batch 4 4"]) -> Bool[Tensor, "*batch"]:
    """Whether poses T_base_tool are not farther away than the robot is long, whatever its joints do."""
    origin = T.new_tensor(robot.base[:3].tolist())
    distance: Tensor = (T[..., :3, 3] - origin).norm(dim=-1)
    return distance <= robot.reach * (1 + REACH_ROUNDING)


def levelled(
    solver: AbstractClosedForm, T: Float64[Tensor, "*batch 4 4"], axes: TaskAxes
) -> Float64[Tensor, "*batch 4 4"]:
    """Poses as a SCARA can take them, if its tool may lean; of other arms as they are.

    They are turned about the tool's point until the last joint's axis is parallel to the first's.
    """
    if solver.robot.dof != 4 or not all(axes.tolerance[3:5]):
        return T
    axis = T[..., :3, :3] @ invert(solver.rows.T_last_tool.to(T))[:3, 2]
    upright = solver.rows.T_base_first.to(T)[:3, 2].expand(axis.shape)
    c = torch.linalg.cross(axis, upright)
    cosine = (axis * upright).sum(-1, keepdim=True)[..., None]
    columns = T[..., :3, :3]
    across = torch.linalg.cross(c[..., None].expand(columns.shape), columns, dim=-2)
    along = c[..., None] * (c[..., None, :] @ columns) / (1 + cosine).clamp(min=1e-6)
    return transform(cosine * columns + across + along, T[..., :3, 3])


def search(
    robot: Robot,
    T: Float64[Tensor, "poses 4 4"],
    starts: Float64[Tensor, "poses _starts dof"],
    hybrid: HybridArm | None = None,
    inside: bool = False,
    axes: TaskAxes = WHOLE,
) -> tuple[Float64[Tensor, "poses dof"], Int64[Tensor, " poses"]]:
    """Solve for poses from one start after the other, until one leads there.

    Args:
        robot: the arm, or a hybrid one without its correction.
        T: wanted poses.
        starts: joint values to begin with [rad or m].
        hybrid: the hybrid arm that is to take the poses, where there is one.
        inside: whether a start that leads there inside the joint limits goes before earlier ones that do not.
        axes: which axes of the tool count.

    Returns:
        Joint values [rad or m], NaN where the status is UNREACHABLE; poses beyond the reach are not tried.
    """
    q = T.new_full((len(T), robot.dof), torch.nan)
    status = torch.full((len(T),), int(Status.UNREACHABLE))
    near = within_reach(robot, T) | any(axes.free[:3])
    alone = 0 if inside else 1
    for tried in (slice(0, alone), slice(alone, None)):  # all but the first at once
        usable = torch.isfinite(starts[:, tried]).all(-1) & (near & (status == Status.UNREACHABLE))[:, None]
        pose, attempt = usable.nonzero().unbind(1)
        if not len(pose):
            continue
        result = _solve_in_axes(robot, T[pose], starts[:, tried][pose, attempt], hybrid, axes)
        good = result.status != Status.NOT_CONVERGED
        if inside:
            attempt = attempt + starts.shape[1] * (result.status == Status.OUTSIDE_JOINT_LIMITS)
        first = torch.full((len(T),), 2 * starts.shape[1]).scatter_reduce(
            0, pose[good], attempt[good], "amin"
        )
        kept = (good & (attempt == first[pose])).nonzero()[:, 0]
        q[pose[kept]], status[pose[kept]] = result.q[kept], result.status[kept]
    return q, status


def _solve_in_axes(
    robot: Robot, T: Tensor, start: Tensor, hybrid: HybridArm | None, axes: TaskAxes
) -> NumericSolution:
    """Solve in the axes that count, by least squares within tolerances where they cannot be met exactly."""
    weights = axes.weights(robot.dof)
    if axes.whole or not axes.has_tolerances or axes.tolerance.count(0.0) >= robot.dof:
        return _solve(robot, T, start, hybrid, axes, weights)
    result = _solve(robot, T, start, hybrid, axes, weights)
    lost = (result.status == Status.NOT_CONVERGED).nonzero()[:, 0]
    arm = None if hybrid is None else partial(hybrid_motion, hybrid, exact=True)
    q = start[lost]
    for motion in (None, arm):
        q = solve_numeric(robot, T[lost], q, motion=motion, axes=axes, weights=axes.loose_weights).q
    exact = [float(value == 0) for value in axes.tolerance]
    if any(exact):
        last = solve_numeric(
            robot, T[lost], q, tolerance=HYBRID_TOLERANCE, motion=arm, axes=axes, weights=exact
        )
        q, status = last.q, last.status
    else:
        status = torch.full((len(lost),), int(Status.REACHED))
    reached = joint_jacobian(robot, q)[0] if arm is None else arm(q)[0]
    status[~tolerated(axes, task_error(axes, T[lost], reached)[0])] = int(Status.NOT_CONVERGED)
    return replace(
        result, q=result.q.index_copy(0, lost, q), status=result.status.index_copy(0, lost, status)
    )


def tolerated(axes: TaskAxes, error: Float64[Tensor, "*batch 6"]) -> Bool[Tensor, "*batch"]:
    """Whether errors in the axes of the tool keep within all tolerances."""
    allowed = [abs(value) * (1 + 1e-9) if value else math.inf for value in axes.tolerance]
    within: Tensor = (error.abs() <= error.new_tensor(allowed)).all(-1)
    return within


def _solve(
    robot: Robot,
    T: Tensor,
    start: Tensor,
    hybrid: HybridArm | None,
    axes: TaskAxes,
    weights: tuple[float, ...],
) -> NumericSolution:
    """Solve for the arm, and from there for the same with its correction, which may reach a little farther.

    First with a Jacobian that is cheap; what it does not solve, near singular poses, with the exact one.
    """
    result = solve_numeric(robot, T, start, max_iterations=ITERATIONS, axes=axes, weights=weights)
    if hybrid is None:
        return result
    close = (result.position_residual < NEARLY * robot.reach) & (result.rotation_residual < NEARLY)
    q, status = result.q.clone(), torch.full_like(result.status, int(Status.NOT_CONVERGED))
    for exact, rounds in ((False, CHEAP_ITERATIONS), (True, EXACT_ITERATIONS)):
        rows = (close & (status == Status.NOT_CONVERGED)).nonzero()[:, 0]
        motion = partial(hybrid_motion, hybrid, exact=exact)
        better = solve_numeric(
            robot,
            T[rows],
            q[rows],
            tolerance=HYBRID_TOLERANCE,
            max_iterations=rounds,
            motion=motion,
            axes=axes,
            weights=weights,
        )
        q[rows], status[rows] = better.q, better.status
    return replace(result, q=q, status=status)


@dataclass(frozen=True, eq=False)
class IdentifiedArm:
    """An arm as drawn and as identified, on one base and with one tool.

    Attributes:
        nominal: the arm as drawn.
        identified: the arm as identified, of a hybrid the geometry that goes with its correction.
        solver: closed form of the nominal arm.
        starts: joint values of calibration rows, with the poses of the identified arm there.
        hybrid: the same with its joint correction, which takes the poses instead, where there is one.
        axes: which axes of the tool count.
    """

    nominal: Robot
    identified: Robot
    solver: AbstractClosedForm
    starts: StoredStarts
    hybrid: HybridArm | None = None
    axes: TaskAxes = WHOLE

    def follow(
        self, T: Float64[Tensor, "*batch 4 4"], q: Float64[Tensor, "*batch dof"]
    ) -> tuple[Float64[Tensor, "*batch dof"], Int64[Tensor, "*batch"]]:
        """Solve for poses from the nominal joint values on; NaN there is UNREACHABLE here.

        Returns:
            Joint values [rad or m] on the turns of q, and a status.
        """
        result, status = search(
            self.identified, T.reshape(-1, 4, 4), q.reshape(-1, 1, q.shape[-1]), self.hybrid, axes=self.axes
        )
        turned = q + wrapped_difference(self.nominal, result.reshape(q.shape), q)
        return turned, status.reshape(q.shape[:-1])

    def recover(
        self,
        T: Float64[Tensor, "poses 4 4"],
        branch: Int64[Tensor, " poses"],
        anywhere: Bool[Tensor, " poses"],
    ) -> tuple[Float64[Tensor, "poses dof"], Int64[Tensor, " poses"], Int64[Tensor, " poses"]]:
        """Solve for poses that the nominal arm does not take on a branch, but the identified one may.

        The starts are the nominal joint values on the branch, almost stretched or folded towards the pose; where any
        branch will do, also those on the others and the calibration rows whose poses are nearest. Without a branch that
        comes near the pose none is tried.

        Args:
            T: wanted poses.
            branch: index of the branch wanted.
            anywhere: where a solution on another branch will do.

        Returns:
            Joint values [rad or m], status, and index of the branch; UNREACHABLE where nothing was found.
        """
        q = T.new_full((len(T), self.nominal.dof), torch.nan)
        status = torch.full_like(branch, Status.UNREACHABLE)
        chosen = within_reach(self.identified, T).nonzero()[:, 0]
        if not len(chosen):
            return q, status, branch
        T_near, wanted = T[chosen], branch[chosen]
        beside = self._beside(T_near)
        first = beside[torch.arange(len(chosen)), wanted][:, None]
        others = torch.cat([beside, self.starts.q[self.starts.nearest(T_near, ATTEMPTS, self.axes)]], 1)
        near = torch.isfinite(beside).all(-1).any(-1) & anywhere[chosen]
        others = torch.where(near[:, None, None], others, torch.nan)
        result, reached = search(
            self.identified, T_near, torch.cat([first, others], 1), self.hybrid, axes=self.axes
        )
        lies = nearest_branch(self.solver, result)
        lost = (lies != wanted) & ~anywhere[chosen]
        result[lost], reached[lost] = torch.nan, int(Status.UNREACHABLE)
        branch = branch.index_copy(0, chosen, torch.where(anywhere[chosen], lies, wanted))
        return q.index_copy(0, chosen, result), status.index_copy(0, chosen, reached), branch

    def _beside(self, T: Float64[Tensor, "poses 4 4"]) -> Float64[Tensor, "poses branches dof"]:
        """Nominal joint values on every branch; NaN on those that are not even near the pose."""
        q = self.solver.starts(levelled(self.solver, T, self.axes))
        each = T[:, None].expand(*q.shape[:-1], 4, 4).reshape(-1, 4, 4)
        off, _ = task_error(self.axes, each, forward_kinematics(self.identified, q.reshape(-1, q.shape[-1])))
        off = (off * off.new_tensor(self.axes.weights(q.shape[-1]))).reshape(*q.shape[:-1], 6)
        off[..., :3] /= self.identified.reach
        return torch.where((off.norm(dim=-1) <= BESIDE)[..., None], q, torch.nan)
