"""Uncertainty of the position of one arm's tool relative to that of another arm."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.calibration.frames.arm_bases import ArmBases
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty
from pisigma.measurement.conditions import JointState
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, skew, transform_from_xyzrpy


@dataclass(frozen=True, eq=False)
class Postures:
    """Postures of an arm.

    Attributes:
        state: commanded joint values and stated conditions.
        q_moved: joint values with their corrections [rad or m].
    """

    state: JointState
    q_moved: Float64[Tensor, "postures dof"]


def tool_to_tool_deviation(bases: ArmBases, first: int, second: int, postures: tuple[Postures, ...]) -> float:
    """Return the RMS standard deviation of the vector from the tool of one arm to that of another [m].

    Unlike the uncertainty of the bases, it does not depend on errors that a base absorbs, such as the zero of joint 1.

    Args:
        bases: the arms.
        first: number of an arm.
        second: number of the other arm.
        postures: postures of every arm; the n-th postures of both arms form a pair.
    """
    moved = [_tool_root(bases, number, postures[number]) for number in (first, second)]
    count = min(map(len, moved))
    return float((moved[1][:count] - moved[0][:count]).square().sum((1, 2)).mean().sqrt())


def _tool_root(bases: ArmBases, number: int, postures: Postures) -> Float64[Tensor, "postures 3 directions"]:
    """Return a root of the covariance of the positions of a tool in the base of the first arm."""
    known = bases.arms[number].uncertainty
    sizes = [arm.root.shape[1] for arm in bases.arms]
    root = bases.arms[number].root @ torch.split(bases.conditioned.z_root, sizes)[number]
    in_base = _own_columns(known, postures) @ root
    R = bases.T_first_base[number, :3, :3]
    T = forward_kinematics(known.geometry.robot, postures.q_moved)
    T_base = transform_from_xyzrpy(torch.from_numpy(known.geometry.robot.base.copy()))
    away = (R @ (invert(T_base) @ T)[:, :3, 3, None])[..., 0]
    shift, turn = bases.covariance_root[number, :3], bases.covariance_root[number, 3:]
    return R @ in_base + shift - skew(away) @ turn


def _own_columns(known: PositionUncertainty, postures: Postures) -> Float64[Tensor, "postures 3 unknowns"]:
    """Return the derivatives of the positions of the first tool in the base of its arm."""
    columns = known.columns(postures.state, postures.q_moved)[:, :3].clone()
    base = known.space.indices_of("base")
    columns[..., base.start : base.stop] = 0.0
    T_base = transform_from_xyzrpy(torch.from_numpy(known.geometry.robot.base.copy()))
    turned: Tensor = T_base[:3, :3].mT @ columns
    return turned
