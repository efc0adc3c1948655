"""Numeric inverse kinematics for any robot, batched: damped Gauss-Newton steps from initial joint values."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from pisigma.files.errors import PoseError
from pisigma.robot.description import Robot
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.jacobian import (
    characteristic_length,
    dimensionless_jacobian,
    joint_jacobian,
    smallest_singular_value,
)
from pisigma.robot.kinematics.joint_limits import wrap_into_limits
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes
from pisigma.robot.kinematics.task_error import is_within_tolerances, task_error
from pisigma.robot.se3 import check_transforms, pose_error

Motion = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Type of functions that return T_base_tool and the joint Jacobian at joint values, like `joint_jacobian`."""


@dataclass(frozen=True, eq=False)
class NumericSolution:
    """Result of numeric inverse kinematics for every pose.

    Attributes:
        q: joint values [rad or m]; if the status is NOT_CONVERGED, the best values found, which do not reach the pose.
        status: a `Status` for every pose: REACHED, SINGULAR, OUTSIDE_JOINT_LIMITS or NOT_CONVERGED.
        position_residual: distance of the tool from the target position [m].
        rotation_residual: angle between the tool and the target orientation [rad].
        iterations: number of Jacobians computed for the pose.
    """

    q: Float[Tensor, "*batch dof"]
    status: Int64[Tensor, "*batch"]
    position_residual: Float[Tensor, "*batch"]
    rotation_residual: Float[Tensor, "*batch"]
    iterations: Int64[Tensor, "*batch"]


@dataclass
class _Iterate:
    """State of the iteration for all poses; only active poses are updated.

    Attributes:
        q: best joint values so far.
        error: pose error at q: translation [m], rotation vector [rad].
        J: joint Jacobian at q.
        damping: factor of the squared scaled error in the damping.
        iterations: number of Jacobians computed.
    """

    q: Float[Tensor, "poses dof"]
    error: Float[Tensor, "poses 6"]
    J: Float[Tensor, "poses 6 dof"]
    damping: Float[Tensor, " poses"]
    iterations: Int64[Tensor, " poses"]

    def converged(self, tolerance: float) -> Bool[Tensor, " poses"]:
        """Return whether both residuals are below the tolerance [m, rad]."""
        position, rotation = self.residuals()
        return (position < tolerance) & (rotation < tolerance)

    def residuals(self) -> tuple[Float[Tensor, " poses"], Float[Tensor, " poses"]]:
        """Return distance [m] and angle [rad] from the target pose."""
        return torch.linalg.vector_norm(self.error[:, :3], dim=-1), torch.linalg.vector_norm(
            self.error[:, 3:], dim=-1
        )


def solve_numeric(
    robot: Robot,
    T: Tensor,
    start: Float[Tensor, "*starts dof"],
    *,
    tolerance: float | None = None,
    max_iterations: int = tolerances.MAX_ITERATIONS,
    motion: Motion | None = None,
    axes: TaskAxes = WHOLE,
    weights: Sequence[float] | None = None,
) -> NumericSolution:
    """Find joint values near a start that reach the poses.

    Each step solves `(JᵀJ + λ) dq = Jᵀe`, with lengths in characteristic lengths and the damping λ proportional to the
    squared error (Sugihara 2011), so convergence is quadratic near the solution. For each pose, a step that
    increases the error is rejected and the damping factor increased; otherwise the factor is decreased. Converged poses
    are no longer updated. No gradients flow through the solution; joint limits are checked only at the end.

    Args:
        robot: the robot, with any number of joints.
        T: target T_base_tool, `(*batch, 4, 4)` [m].
        start: initial joint values [rad or m]; batch dimensions broadcast with those of T.
        tolerance: residuals at which the iteration has converged [m and rad]; None for 1e-13 in float64 and 1e-5 in
            float32.
        max_iterations: largest number of steps.
        motion: pose and Jacobian of an arm with joint corrections; the Jacobian need not be exact. None for those of
            the robot.
        axes: tool axes and tolerances of the task.
        weights: weights of the six tool axes in least squares, 0 for an ignored axis; None for `axes.weights`.

    Returns:
        The solution to which the iteration converged. If it did not converge, the status is NOT_CONVERGED, and q
        contains the best values found, with the stated residuals.

    Raises:
        PoseError: T is not a stack of rigid transforms, or start is not finite or lacks the shape that robot and T
            require.
    """
    check_transforms(T, "T_base_tool")
    _check_start(robot, T, start)
    if tolerance is None:
        tolerance = tolerances.TOLERANCE if T.dtype == torch.float64 else 1e-5
    batch = np.broadcast_shapes(T.shape[:-2], start.shape[:-1])
    T_flat = T.detach().expand(*batch, 4, 4).reshape(-1, 4, 4)
    with torch.no_grad():
        counted = T_flat.new_tensor(weights or axes.weights(robot.dof))
        task = TaskMotion(motion or partial(joint_jacobian, robot), axes, counted)
        state = _initial(task, T_flat, start.detach().expand(*batch, robot.dof).reshape(-1, robot.dof))
        active = (~state.converged(tolerance)).nonzero()[:, 0]
        for _ in range(max_iterations):
            if active.numel() == 0:
                break
            _iterate(robot, task, T_flat, state, active)
            stalled = state.damping[active] > tolerances.MAX_DAMPING
            active = active[~(state.converged(tolerance)[active] | stalled)]
        return _finish(robot, state, tolerance, batch, task.used_axis_count)


def _check_start(robot: Robot, T: Tensor, start: Tensor) -> None:
    robot.check_joint_count(start.shape[-1])
    if start.dtype != T.dtype:
        expected = f"{T.dtype} as in T_base_tool"
        raise PoseError(
            f"expected {expected}, got {start.dtype}",
            expected=expected,
            value=str(start.dtype),
            option="start",
        )
    try:
        np.broadcast_shapes(T.shape[:-2], start.shape[:-1])
    except ValueError:
        shapes = tuple(start.shape[:-1]), tuple(T.shape[:-2])
        raise PoseError(
            f"the batch shape {shapes[0]} does not broadcast with that of T_base_tool, {shapes[1]}",
            expected=f"a batch shape that broadcasts with {shapes[1]}",
            value=shapes[0],
            option="start",
            remedy="give one start for each pose, or one for all",
        ) from None
    bad = ~torch.isfinite(start).all(-1)
    if bad.any():
        index = tuple(bad.nonzero()[0].tolist())
        raise PoseError(
            f"the joint values at index {index} are not finite",
            expected="finite numbers",
            value=index,
            option="start",
            remedy="give a start for every pose, such as the nearest solution of another branch",
        )


@dataclass(frozen=True, eq=False)
class TaskMotion:
    """Weighted pose errors of an arm in the tool axes of a task.

    Attributes:
        motion: function that returns pose and Jacobian.
        axes: tool axes and tolerances of the task.
        weights: weights of the six tool axes in least squares.
    """

    motion: Motion
    axes: TaskAxes
    weights: Float[Tensor, " 6"]

    @property
    def used_axis_count(self) -> int:
        """Number of task axes with a nonzero weight."""
        return int(self.weights.count_nonzero())

    def errors(
        self, T: Float[Tensor, "poses 4 4"], q: Float[Tensor, "poses dof"]
    ) -> tuple[Float[Tensor, "poses 6"], Float[Tensor, "poses 6 dof"]]:
        """Return the weighted errors of the poses at joint values relative to the target poses, and their Jacobian."""
        reached, J = self.motion(q)
        if self.axes.is_exact:
            return pose_error(T, reached), J.clone()
        error, turn = task_error(self.axes, T, reached)
        return self.weights * error, self.weights[:, None] * (turn @ J)


def _initial(task: TaskMotion, T: Float[Tensor, "poses 4 4"], q: Float[Tensor, "poses dof"]) -> _Iterate:
    error, J = task.errors(T, q)
    damping = torch.full_like(q[:, 0], tolerances.INITIAL_DAMPING)
    return _Iterate(q.clone(), error, J, damping, torch.ones_like(damping, dtype=torch.int64))


def _iterate(
    robot: Robot,
    task: TaskMotion,
    T: Float[Tensor, "poses 4 4"],
    state: _Iterate,
    active: Int64[Tensor, " active"],
) -> None:
    """Try one step for the active poses, and keep the steps that decrease the error."""
    old = _scaled(robot, state.error[active])
    trial = state.q[active] + damped_step(
        robot, state.J[active], old, state.damping[active], task.used_axis_count
    )
    error, J = task.errors(T[active], trial)
    better = _scaled(robot, error).square().sum(-1) < old.square().sum(-1)
    state.iterations[active] += 1
    factor = torch.where(better, tolerances.DAMPING_DOWN, tolerances.DAMPING_UP).to(state.damping)
    state.damping[active] = (state.damping[active] * factor).clamp(min=tolerances.MIN_DAMPING)
    kept = active[better]
    state.q[kept], state.error[kept], state.J[kept] = trial[better], error[better], J[better]


def _scaled(robot: Robot, error: Float[Tensor, "poses 6"]) -> Float[Tensor, "poses 6"]:
    return error / error.new_tensor([characteristic_length(robot)] * 3 + [1.0] * 3)


def damped_step(
    robot: Robot,
    J: Float[Tensor, "poses 6 dof"],
    scaled_error: Float[Tensor, "poses 6"],
    damping: Float[Tensor, " poses"],
    nonzero_row_count: int = 6,
) -> Float[Tensor, "poses dof"]:
    """Compute the damped least-squares step [rad or m] from the smaller of the two forms of the normal equations.

    Args:
        robot: the robot.
        J: joint Jacobian.
        scaled_error: pose error with translation in characteristic lengths.
        damping: factor of the squared error in the damping; the product is kept above the rounding level.
        nonzero_row_count: number of nonzero rows of the Jacobian.
    """
    A = dimensionless_jacobian(robot, J).contiguous()
    small = A.mT @ A if robot.dof < nonzero_row_count else A @ A.mT
    # Near the solution the damping vanishes, and rounding could make a singular matrix indefinite.
    floor = 4 * torch.finfo(A.dtype).eps * small.diagonal(dim1=-2, dim2=-1).sum(-1)
    weight = damping * scaled_error.square().sum(-1) + floor
    small = small + weight[:, None, None] * torch.eye(small.shape[-1], dtype=A.dtype, device=A.device)
    error = scaled_error[..., None]
    factor, _ = torch.linalg.cholesky_ex(small)
    if robot.dof < nonzero_row_count:
        step = torch.cholesky_solve(A.mT @ error, factor)[..., 0]
    else:
        step = (A.mT @ torch.cholesky_solve(error, factor))[..., 0]
    lengths = [1.0 if revolute else characteristic_length(robot) for revolute in robot.revolute]
    return step * step.new_tensor(lengths)


def _finish(
    robot: Robot, state: _Iterate, tolerance: float, batch: tuple[int, ...], rows: int
) -> NumericSolution:
    q, inside = wrap_into_limits(robot, state.q)
    singular_tolerance = tolerances.SINGULAR_TOLERANCE if q.dtype == torch.float64 else 3e-3
    singular = smallest_singular_value(robot, state.J, rows) < singular_tolerance
    status = torch.where(singular, int(Status.SINGULAR), int(Status.REACHED))
    status = torch.where(inside, status, int(Status.OUTSIDE_JOINT_LIMITS))
    converged = state.converged(tolerance)
    status = torch.where(converged, status, int(Status.NOT_CONVERGED))
    position, rotation = state.residuals()
    return NumericSolution(
        q=torch.where(converged[:, None], q, state.q).reshape(*batch, robot.dof),
        status=status.reshape(batch),
        position_residual=position.reshape(batch),
        rotation_residual=rotation.reshape(batch),
        iterations=state.iterations.reshape(batch),
    )


def solve_within_tolerances(
    robot: Robot,
    T: Float[Tensor, "poses 4 4"],
    start: Float[Tensor, "poses dof"],
    motion: Motion,
    axes: TaskAxes,
) -> tuple[Float[Tensor, "poses dof"], Bool[Tensor, " poses"]]:
    """Find joint values that minimise errors divided by their tolerances, for arms with too few joints for all axes.

    Axes without tolerance are met exactly.

    Args:
        robot: the robot.
        T: target T_base_tool [m].
        start: initial joint values [rad or m].
        motion: function that returns pose and Jacobian.
        axes: tool axes of the task, some of them with tolerances.

    Returns:
        Joint values [rad or m], and whether all errors are within the tolerances.
    """
    q = solve_numeric(robot, T, start, motion=motion, axes=axes, weights=axes.loose_weights).q
    exact, met = [float(value == 0) for value in axes.tolerance], torch.ones_like(q[:, 0], dtype=torch.bool)
    if any(exact):
        last = solve_numeric(
            robot, T, q, tolerance=tolerances.HYBRID_TOLERANCE, motion=motion, axes=axes, weights=exact
        )
        q, met = last.q, last.status != Status.NOT_CONVERGED
    return q, met & is_within_tolerances(axes, task_error(axes, T, motion(q)[0])[0])


def approach_preferred(
    robot: Robot,
    task: TaskMotion,
    T: Float[Tensor, "poses 4 4"],
    q: Float[Tensor, "poses dof"],
    preferred: Float[Tensor, "poses dof"],
    motion_scale: Float[Tensor, " dof"],
) -> Float[Tensor, "poses dof"]:
    """Move the joints of a redundant arm as near to preferred values as pose and limits allow.

    The kernels select the joint values of redundant arms in the same way. Every step minimises `|(dq - pull) / units|`
    subject to `J dq = e` (sequential quadratic programming). A joint that reaches a limit is fixed there. If the result
    does not reach the pose, the joint values are unchanged.

    Args:
        robot: the robot.
        task: weighted pose errors of the arm in the axes of the task.
        T: target poses.
        q: joint values that reach them [rad or m].
        preferred: preferred joint values [rad or m].
        motion_scale: scale of the motion of every joint [rad or m].
    """
    length, limits = characteristic_length(robot), torch.from_numpy(robot.limits)
    rows = T.new_tensor([1 / length] * 3 + [1.0] * 3)
    scale, share = motion_scale.expand_as(q).clone(), torch.ones_like(q[:, :1])
    before, best, active = torch.full_like(share, torch.inf), q.clone(), torch.ones(len(q), dtype=torch.bool)
    for _ in range(tolerances.MAX_STEPS):
        if not active.any():
            break
        error, J = task.errors(T, best)
        # Motion of the joints if the pose did not matter; a joint at its limit (scale 0) no longer moves.
        pull = torch.where(scale > 0, share * (preferred - best), 0.0)
        A = rows[:, None] * J * scale[:, None]
        # The smallest scaled motion that reaches the pose cancels the effect of the pull on the tool.
        left = rows * (error - (J @ pull[..., None])[..., 0])
        small = A @ A.mT
        floor = 4 * torch.finfo(A.dtype).eps * small.diagonal(dim1=-2, dim2=-1).sum(-1)
        factor, _ = torch.linalg.cholesky_ex(small + floor[:, None, None] * torch.eye(6, dtype=A.dtype))
        step = pull + scale * (A.mT @ torch.cholesky_solve(left[..., None], factor))[..., 0]
        moved = step.abs().amax(-1, keepdim=True)
        # Steps that do not become shorter oscillate, so the pull is reduced.
        share, before = torch.where(moved > 0.7 * before, 0.6 * share, share), moved
        trial = best + step * (tolerances.MAX_STEP / moved).clamp(max=1.0)
        inside = torch.minimum(torch.maximum(trial, limits[:, 0]), limits[:, 1])
        scale = torch.where(active[:, None] & (inside != trial), 0.0, scale)
        best = torch.where(active[:, None], inside, best)
        active &= (moved >= tolerances.STEP_TOLERANCE)[:, 0]
    start = torch.where(torch.isfinite(best).all(-1, keepdim=True), best, q)
    result = solve_numeric(
        robot, T, start, tolerance=tolerances.HYBRID_TOLERANCE, motion=task.motion, axes=task.axes
    )
    return torch.where((result.status != Status.NOT_CONVERGED)[:, None], result.q, q)
