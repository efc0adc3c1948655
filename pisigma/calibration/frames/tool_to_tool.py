"""Uncertainty of the position of one arm's tool relative to that of another arm."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.arm_bases import ArmBases
from pisigma.calibration.frames.shared_objects import Postures
from pisigma.measurement.conditions import JointState
from pisigma.robot.se3 import skew


def tool_to_tool_deviation(bases: ArmBases, first: int, second: int, postures: tuple[Postures, ...]) -> float:
    """Return the RMS standard deviation of the vector from the tool of one arm to that of another [m].

    Unlike the uncertainty of the bases, it does not depend on errors that a base absorbs, such as the zero of joint 1.

    Args:
        bases: the arms.
        first: number of an arm.
        second: number of the other arm.
        postures: postures of every arm; the n-th postures of both arms form a pair, in which the shared joints of a
            torso have the values of the first arm.
    """
    count = min(len(postures[number].q_corrected) for number in (first, second))
    one, other = (postures[number][torch.arange(count)] for number in (first, second))
    shared = bases.joints_in_common(first, second)
    q, moved = other.state.q.clone(), other.q_corrected.clone()
    q[:, :shared], moved[:, :shared] = one.state.q[:, :shared], one.q_corrected[:, :shared]
    other = Postures(JointState(q, other.state.conditions), moved)
    apart = _tool_root(bases, second, other) - _tool_root(bases, first, one)
    return float(apart.square().sum((1, 2)).mean().sqrt())


def _tool_root(bases: ArmBases, number: int, postures: Postures) -> Float64[Tensor, "postures 3 directions"]:
    """Return a root of the covariance of the positions of a tool in the base of the first arm."""
    arm = bases.arms[number]
    sizes = [one.covariance_root.shape[1] for one in bases.arms]
    T, columns = arm.positions_in_base(postures)
    in_base = columns @ (arm.covariance_root @ torch.split(bases.conditioned.z_root, sizes)[number])
    R = bases.T_first_base[number, :3, :3]
    away = (R @ T[:, :3, 3, None])[..., 0]
    shift, turn = bases.covariance_root[number, :3], bases.covariance_root[number, 3:]
    return R @ in_base + shift - skew(away) @ turn
