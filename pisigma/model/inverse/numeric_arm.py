"""A calibrated arm in torch: Newton iterations towards poses, and gradients of joint values with respect to the pose.

Iterations are in the constrained axes of the tool; gradients follow from the implicit function theorem.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.model.calibrated_model import CalibratedModel, hybrid_motion
from pisigma.model.inverse.solution import Solution
from pisigma.robot.description import Robot
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.jacobian import (
    characteristic_length,
    dimensionless_jacobian,
    joint_jacobian,
    smallest_singular_value,
)
from pisigma.robot.kinematics.joint_limits import nearest_turn, wrap_into_limits, wrapped_difference
from pisigma.robot.kinematics.numeric import (
    Motion,
    TaskMotion,
    approach_preferred,
    solve_numeric,
    solve_within_tolerances,
)
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes
from pisigma.robot.kinematics.task_error import task_error
from pisigma.robot.kinematics.tolerances import SINGULAR_TOLERANCE
from pisigma.robot.se3 import skew

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

    def iterate_to_poses(
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
        return smallest_singular_value(self.robot, J, self._task.used_axis_count)

    @cached_property
    def _task(self) -> TaskMotion:
        weights = torch.tensor(self.weights, dtype=torch.float64)
        return TaskMotion(self.motion_functions[0], self.axes, weights)

    @cached_property
    def _travel(self) -> tuple[Tensor, Tensor]:
        """Joint limits and half the range between them [rad or m]."""
        limits = torch.from_numpy(self.nominal.limits)
        return limits, ((limits[:, 1] - limits[:, 0]) / 2).clamp(min=1e-9)


def as_tensor(values: Any) -> Tensor:
    """Return values as a tensor on the CPU."""
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values, order="C"))


def in_type_of_poses(
    solution: Solution, poses: Float[Tensor, "*batch 4 4"], model: CalibratedModel | None, axes: TaskAxes
) -> Solution:
    """Return solutions with the dtype and device of the poses, and with gradients with respect to them.

    Args:
        solution: tensors on the CPU; solutions of all branches have one batch axis more than the poses.
        poses: poses as passed by the caller.
        model: calibrated model; None if no gradients are required.
        axes: axes of the tool that are constrained.
    """
    if model is not None and torch.is_grad_enabled():
        every = poses.unsqueeze(-3) if solution.status.ndim > poses.ndim - 2 else poses
        solution = with_pose_gradients(model, solution, every.expand(*solution.status.shape, 4, 4), axes)
    return replace(
        solution,
        q=solution.q.to(poses),
        q_nominal=solution.q_nominal.to(poses),
        branch=solution.branch.to(poses.device),
        status=solution.status.to(poses.device),
        position_residual=solution.position_residual.to(poses.device),
        rotation_residual=solution.rotation_residual.to(poses.device),
        domain_measure=solution.domain_measure.to(poses),
    )


def with_pose_gradients(
    model: CalibratedModel, result: Solution, T: Float[Tensor, "*batch 4 4"], axes: TaskAxes = WHOLE
) -> Solution:
    """Return the solutions with gradients of `q` and `q_nominal` with respect to the poses.

    A solution satisfies `FK(q) = T`. When the pose moves by a twist ξ (translation and rotation vector in the base
    frame), the joints follow by `dq = J⁺ ξ`, where J is the Jacobian of the calibrated arm including the slope of its
    correction. A network on nominal joint values is differentiated as `q = q_nominal + Δ(T, q_nominal)` with
    `dq_nominal = J_nominal⁺ ξ`.

    J⁺ is the pseudo-inverse of the dimensionless Jacobian, without singular values below `SINGULAR_TOLERANCE`. It is
    the inverse if this exists; for a redundant arm, it yields the smallest joint motion, and for fewer than six joints
    or at a singular pose, the joints follow the part of ξ that the tool can follow. Changes of T that are not motions
    (shear, scale) do not contribute. The gradient of a solution that is NaN is 0, so it can be masked. Only first
    derivatives are available. If some axes of the tool are not constrained, ξ and J are restricted to the constrained
    axes.

    Args:
        model: calibrated model.
        result: float64 solutions on the CPU.
        T: poses that require gradients, of any dtype and device.
        axes: axes of the tool that are constrained.
    """
    T = T.to("cpu", torch.float64)
    motions: dict[str, Motion] = {"q_nominal": partial(joint_jacobian, model.robot)}
    if model.calibrated is not None:
        identified, hybrid = model.identified, model.hybrid
        motions["q"] = (
            partial(joint_jacobian, identified) if hybrid is None else partial(hybrid_motion, hybrid)
        )
    attached: dict[str, Any] = {
        name: _attached(model.robot, T, axes, getattr(result, name), motion)
        for name, motion in motions.items()
    }
    if model.calibrated is not None:
        return replace(result, **attached)
    q_nominal = attached["q_nominal"]
    if model.network is None:
        return replace(result, q=q_nominal + result.correction, q_nominal=q_nominal)
    known = torch.isfinite(result.q).all(-1, keepdim=True)
    safe = torch.where(known, q_nominal, 0.0)
    near_training = safe + (model.wrapped_near_training(safe.detach()) - safe.detach())
    correction = torch.where(known, model.network(T, near_training), torch.nan)
    return replace(result, q=q_nominal + correction, q_nominal=q_nominal)


def _twist(T: Float64[Tensor, "*batch 4 4"]) -> Float64[Tensor, "*batch 6"]:
    """Return the twist of poses relative to themselves [m, rad], which is 0, with its derivatives."""
    still = T.detach()
    turn = T[..., :3, :3] @ still[..., :3, :3].mT
    turned = [turn[..., k, j] - turn[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
    return torch.cat([T[..., :3, 3] - still[..., :3, 3], torch.stack(turned, -1) / 2], -1)


def _attached(robot: Robot, T: Tensor, axes: TaskAxes, q: Tensor, motion: Motion) -> Tensor:
    """Return joint values with gradients with respect to the poses; `motion` evaluates rows of joint values."""
    twist, flat = _twist(T), q.detach().reshape(-1, q.shape[-1])
    rows = torch.isfinite(flat).all(-1).nonzero()[:, 0]
    inverse = flat.new_zeros(len(flat), q.shape[-1], 6)
    if len(rows):
        inverse[rows] = _inverse(robot, T.detach().reshape(-1, 4, 4)[rows], axes, *motion(flat[rows]))
    result: Tensor = _Implicit.apply(twist, q.detach(), inverse.reshape(*q.shape, 6))  # type: ignore[no-untyped-call]
    return result


def _inverse(robot: Robot, T: Tensor, axes: TaskAxes, reached: Tensor, J: Tensor) -> Tensor:
    """Compute matrices from twists of target poses to joint motions in the constrained axes, `(poses, dof, 6)`."""
    if axes.is_exact:
        return pseudo_inverse(robot, J)
    _, turn = task_error(axes, T, reached)
    turn = turn * turn.new_tensor(axes.weights(robot.dof))[:, None]
    wanted = turn.clone()  # the deviation along free axes rotates with the target tool
    wanted[:, :, 3:] += turn[:, :, :3] @ skew(T[:, :3, 3] - reached[:, :3, 3])
    return pseudo_inverse(robot, turn @ J) @ wanted


def pseudo_inverse(robot: Robot, J: Float64[Tensor, "poses 6 dof"]) -> Float64[Tensor, "poses dof 6"]:
    """Compute matrices from twists [m, rad] to joint motions [rad or m]; see `with_pose_gradients`."""
    length = characteristic_length(robot)
    result: Tensor = torch.linalg.pinv(
        dimensionless_jacobian(robot, J).contiguous(), atol=SINGULAR_TOLERANCE, rtol=0.0
    )
    joints = J.new_tensor([1.0 if revolute else length for revolute in robot.revolute])
    scaled: Tensor = joints[:, None] * result * J.new_tensor([1 / length] * 3 + [1.0] * 3)
    return scaled


class _Implicit(torch.autograd.Function):
    """Identity function with a given derivative."""

    @staticmethod
    def forward(ctx: Any, twist: Tensor, q: Tensor, inverse: Tensor) -> Tensor:
        ctx.save_for_backward(inverse)
        return q.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (inverse,) = ctx.saved_tensors
        return (gradient[..., None, :] @ inverse)[..., 0, :], None, None
