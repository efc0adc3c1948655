"""Gradients of joint values with respect to the target pose, by the implicit function theorem."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor
from torch.autograd.function import once_differentiable

from pisigma.model.calibrated_model import CalibratedModel, hybrid_motion
from pisigma.model.inverse.solution import AbstractInverse, Solution
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.jacobian import characteristic_length, dimensionless_jacobian, joint_jacobian
from pisigma.robot.kinematics.numeric import Motion
from pisigma.robot.kinematics.task_axes import WHOLE, TaskAxes
from pisigma.robot.kinematics.task_error import task_error
from pisigma.robot.kinematics.tolerances import SINGULAR_TOLERANCE
from pisigma.robot.se3 import skew


def as_tensors(
    solution: Solution,
    poses: Float[Tensor, "*batch 4 4"],
    model: CalibratedModel | None,
    owner: AbstractInverse,
    axes: TaskAxes,
) -> Solution:
    """Return solutions as tensors with the dtype and device of the poses, and with gradients with respect to them.

    Args:
        solution: float64 arrays or tensors on the CPU; solutions of all branches have one batch axis more than the
            poses.
        poses: poses as passed by the caller.
        model: calibrated model; None if no gradients are required.
        owner: see `Solution`.
        axes: axes of the tool that are constrained.
    """
    result = solution.map(_tensor)
    if model is not None and torch.is_grad_enabled():
        every = poses.unsqueeze(-3) if result.status.ndim > poses.ndim - 2 else poses
        result = with_pose_gradients(model, result, every.expand(*result.status.shape, 4, 4), axes)
    return replace(
        result,
        q=result.q.to(poses),
        q_nominal=result.q_nominal.to(poses),
        branch=result.branch.to(poses.device),
        status=result.status.to(poses.device),
        domain_measure=result.domain_measure.to(poses),
        owner=owner,
    )


def _tensor(values: Any) -> Tensor:
    return values if isinstance(values, Tensor) else torch.from_numpy(np.asarray(values, order="C"))


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
    q_nominal = _attached(model.robot, T, axes, result.q_nominal, partial(joint_jacobian, model.robot))
    if model.calibrated is not None:
        identified, hybrid = model.identified, model.hybrid

        motion: Motion = (
            partial(joint_jacobian, identified) if hybrid is None else partial(hybrid_motion, hybrid)
        )
        q = _attached(model.robot, T, axes, result.q, motion)
        return replace(result, q=q, q_nominal=q_nominal)
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
