"""Where the tool of a hybrid arm is and how it moves, a chunk of poses at a time."""

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.jacobian import joint_jacobian

CHUNK = 4_096
"""Poses whose features are in memory at a time: a few hundred columns a joint."""

STEP = 1e-5
"""[rad or m] Of differences: with 100 cycles a turn their error is a millionth of a slope."""


def hybrid_poses(arm: HybridArm, q: Float[Tensor, "*batch dof"]) -> Float[Tensor, "*batch 4 4"]:
    """Poses T_base_tool of an arm at commanded joint values [rad or m], of any number of rows.

    Raises:
        PoseError: q has another number of columns than the robot has joints.
    """
    arm.robot.check_joint_count(q.shape[-1])
    flat = q.reshape(-1, q.shape[-1])
    return torch.cat([arm.forward(part) for part in torch.split(flat, CHUNK)]).reshape(*q.shape[:-1], 4, 4)


def corrected_joints(arm: HybridArm, measurements: Measurements) -> Float64[Tensor, "rows dof"]:
    """Joint values of measured rows with the correction of the network in full, `q + Δ(q)` [rad or m]."""
    chunks = JointState.of(measurements).split(CHUNK)
    with torch.no_grad():
        return torch.cat([state.q + arm.correction(state) for state in chunks])


def hybrid_motion(
    arm: HybridArm, q: Float[Tensor, "poses dof"], exact: bool = True
) -> tuple[Float[Tensor, "poses 4 4"], Float[Tensor, "poses 6 dof"]]:
    """Poses and joint Jacobian `J(q + Δ) (1 + dΔ/dq)` of a hybrid arm.

    Args:
        arm: the arm.
        q: commanded joint values [rad or m].
        exact: whether dΔ/dq is computed, which costs some times as much as Δ. Without it Newton steps contract by
            |dΔ/dq|, of the order of 1e-2.
    """
    chunk = CHUNK // (2 * q.shape[1]) if exact else CHUNK
    with torch.no_grad():
        parts = [_motion(arm, part, exact) for part in torch.split(q, chunk)]
    T, J = zip(*parts, strict=True)
    return torch.cat(T), torch.cat(J)


def _motion(arm: HybridArm, q: Tensor, exact: bool) -> tuple[Tensor, Tensor]:
    T, J = joint_jacobian(arm.robot, q + arm.delta(q))
    if exact:
        J = J + J @ _slope(arm, q)
    return T, J


def _slope(arm: HybridArm, q: Float[Tensor, "poses dof"]) -> Float[Tensor, "poses dof dof"]:
    """Derivatives of the corrections by the joint values, by central differences in one call."""
    step = STEP * torch.eye(q.shape[1], dtype=q.dtype, device=q.device)
    above, below = torch.chunk(arm.delta(q[:, None] + torch.cat([step, -step])), 2, 1)
    slope: Tensor = (above - below).mT / (2 * STEP)
    return slope
