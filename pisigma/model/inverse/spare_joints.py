"""Joints to spare in torch: which of the many solutions of a redundant arm is taken, as the kernels choose it."""

from functools import partial

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.model.hybrid_motion import hybrid_motion
from pisigma.model.inverse.identified_arm import search
from pisigma.model.stored_starts import StoredStarts
from pisigma.robot.description import Robot
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.joint_limits import wrap_into_limits
from pisigma.robot.kinematics.numeric import Motion, TaskMotion, solve_numeric
from pisigma.robot.kinematics.singularity import characteristic_length, smallest_singular_value
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import TaskAxes
from pisigma.robot.kinematics.tolerances import ATTEMPTS, MORE_ATTEMPTS

OUTSIDE = 1e6
"""What is taken from the worth of joint values outside their limits."""


def solve_with_spare_joints(
    stored: StoredStarts,
    hybrid: HybridArm | None,
    T: Float64[Tensor, "poses 4 4"],
    near: Float64[Tensor, "poses dof"] | None,
    axes: TaskAxes,
) -> tuple[Float64[Tensor, "poses dof"], Int64[Tensor, " poses"]]:
    """Solve for poses that leave an arm joints to spare, from `near`, else from the stored starts nearest to the poses.

    Args:
        stored: the starts, and the arm, of a hybrid one without its correction.
        hybrid: the hybrid arm, where there is one.
        T: wanted poses.
        near: joint values to be near to [rad or m], or None.
        axes: which axes of the tool count.

    Returns:
        Joint values [rad or m], NaN where the status is UNREACHABLE, and the status, REACHED elsewhere.
    """
    q = T.new_full((len(T), stored.robot.dof), torch.nan)
    inside = torch.zeros(len(T), dtype=torch.bool)
    for attempts in (0, ATTEMPTS, MORE_ATTEMPTS):
        left = (~inside).nonzero()[:, 0]
        if not len(left) or (attempts == 0 and near is None):
            continue
        beside = None if near is None else near[left]
        starts = (
            stored.q[stored.nearest(T[left], attempts, axes)]
            if beside is None or attempts
            else beside[:, None]
        )
        other, within = best_of_starts(stored.robot, hybrid, T[left], starts, beside, axes)
        better = within | ~torch.isfinite(q[left]).all(-1)
        q[left[better]], inside[left[better]] = other[better], within[better]
    reached = torch.isfinite(q).all(-1)
    return q, torch.where(reached, int(Status.REACHED), int(Status.UNREACHABLE))


def best_of_starts(
    robot: Robot,
    hybrid: HybridArm | None,
    T: Float64[Tensor, "poses 4 4"],
    starts: Float64[Tensor, "poses starts dof"],
    near: Float64[Tensor, "poses dof"] | None,
    axes: TaskAxes,
) -> tuple[Float64[Tensor, "poses dof"], Bool[Tensor, " poses"]]:
    """Solve from every start, move joints to where they are preferred, and take the best solution.

    That is the one nearest to `near`, else the one with the largest product of the singularity measure and the smallest
    distance of a joint from its limits over half its travel.

    Args:
        robot: the arm, or a hybrid one without its correction.
        hybrid: the hybrid arm, where there is one.
        T: wanted poses.
        starts: joint values to begin with [rad or m].
        near: joint values to be near to [rad or m], or None.
        axes: which axes of the tool count.

    Returns:
        Joint values, NaN where no start leads there, and whether they are inside the limits.
    """
    count, dof = starts.shape[1], robot.dof
    each, motion = T.repeat_interleave(count, 0), _motion(robot, hybrid)
    q, status = search(robot, each, starts.reshape(-1, 1, dof), hybrid, axes=axes)
    found = (status != Status.UNREACHABLE).nonzero()[:, 0]
    limits = torch.from_numpy(robot.limits)
    half = ((limits[:, 1] - limits[:, 0]) / 2).clamp(min=1e-9)
    beside = None if near is None else near.repeat_interleave(count, 0)[found]
    preferred = limits.mean(-1).expand(len(found), dof) if beside is None else beside
    units = half if beside is None else torch.ones_like(half)
    solved, _ = wrap_into_limits(robot, q[found])
    task = TaskMotion(motion, axes, T.new_tensor(axes.weights(dof)))
    solved = approach_preferred(robot, task, each[found], solved, preferred, units)
    solved, inside = wrap_into_limits(robot, solved)
    if beside is None:
        margin = torch.minimum(solved - limits[:, 0], limits[:, 1] - solved).div(half).clamp(max=1.0).amin(-1)
        _, J = task.errors(each[found], solved)
        worth = margin * smallest_singular_value(robot, J, task.rows)
    else:
        worth = -(solved - beside).norm(dim=-1)
    rank = torch.full((len(each),), -torch.inf, dtype=torch.float64)
    rank[found] = torch.where(inside, worth, worth - OUTSIDE)
    q[found] = solved
    best = rank.reshape(-1, count).argmax(-1)
    rows = torch.arange(len(T)) * count + best
    return q[rows], rank[rows] > -OUTSIDE / 2


def _motion(robot: Robot, hybrid: HybridArm | None) -> Motion:
    return partial(joint_jacobian, robot) if hybrid is None else partial(hybrid_motion, hybrid, exact=False)


def approach_preferred(
    robot: Robot,
    task: TaskMotion,
    T: Float64[Tensor, "poses 4 4"],
    q: Float64[Tensor, "poses dof"],
    preferred: Float64[Tensor, "poses dof"],
    units: Float64[Tensor, " dof"],
) -> Float64[Tensor, "poses dof"]:
    """Move joints as near to preferred values as the pose and the limits allow.

    Every step solves `min |(dq - pull) / units|` where `J dq = e` holds (sequential quadratic programming). A joint
    that comes to a limit is held there. Where that leads away from the pose, the joint values stay.

    Args:
        robot: the robot.
        task: the arm in the axes that count.
        T: wanted poses.
        q: joint values that reach them [rad or m].
        preferred: joint values to come near to [rad or m].
        units: joint motions that count as one [rad or m].
    """
    length, limits = characteristic_length(robot), torch.from_numpy(robot.limits)
    rows = T.new_tensor([1 / length] * 3 + [1.0] * 3)
    scale, share = units.expand_as(q).clone(), torch.ones_like(q[:, :1])
    before, best, active = torch.full_like(share, torch.inf), q.clone(), torch.ones(len(q), dtype=torch.bool)
    for _ in range(tolerances.ROUNDS):
        if not active.any():
            break
        error, J = task.errors(T, best)
        pull = torch.where(scale > 0, share * (preferred - best), 0.0)
        A = rows[:, None] * J * scale[:, None]
        left = rows * (error - (J @ pull[..., None])[..., 0])
        small = A @ A.mT
        floor = 4 * torch.finfo(A.dtype).eps * small.diagonal(dim1=-2, dim2=-1).sum(-1)
        factor, _ = torch.linalg.cholesky_ex(small + floor[:, None, None] * torch.eye(6, dtype=A.dtype))
        step = pull + scale * (A.mT @ torch.cholesky_solve(left[..., None], factor))[..., 0]
        moved = step.abs().amax(-1, keepdim=True)
        share, before = torch.where(moved > 0.7 * before, 0.6 * share, share), moved
        trial = best + step * (tolerances.STRIDE / moved).clamp(max=1.0)
        inside = torch.minimum(torch.maximum(trial, limits[:, 0]), limits[:, 1])
        scale = torch.where(active[:, None] & (inside != trial), 0.0, scale)
        best = torch.where(active[:, None], inside, best)
        active &= (moved >= tolerances.STILL)[:, 0]
    start = torch.where(torch.isfinite(best).all(-1, keepdim=True), best, q)
    result = solve_numeric(
        robot, T, start, tolerance=tolerances.HYBRID_TOLERANCE, motion=task.motion, axes=task.axes
    )
    return torch.where((result.status != Status.NOT_CONVERGED)[:, None], result.q, q)
