"""Where the tool of an arm is and how it moves, with the correction and its fading, on plain numbers."""

import math
from typing import no_type_check

from numba import njit

from pisigma.kernels.arrays import BLENDED, GEOMETRIC, HYBRID
from pisigma.kernels.chain import jacobian, walk
from pisigma.kernels.joint_correction import joint_correction
from pisigma.kernels.rotations import rotation_from_vector, rotation_vector
from pisigma.kernels.rows import Array, Record


@njit(error_model="numpy")
@no_type_check
def correct(description: Record, memory: Record, q: Array) -> None:
    """Write Δ(q) into `memory.delta` and q + Δ(q) into `memory.theta`."""
    arms, correction = description.arms, description.correction
    joint_correction(arms, correction, memory, q)
    for j in range(arms.dof):
        memory.theta[j] = q[j] + memory.delta[j]


@njit(error_model="numpy")
@no_type_check
def covered(description: Record, q: Array) -> tuple[float, int, float]:
    """Share of the correction that is in force; which joint limits it; and the slope by that joint's value."""
    coverage, arms = description.coverage, description.arms
    worst, limiting, side = 0.0, 0, 0.0
    for j in range(arms.dof):
        angle = q[j] * coverage.rate[j]
        least, way = math.inf, 0.0
        for s in range(coverage.stretches):
            if coverage.joint[s] == j:
                off = angle - coverage.middle[s]
                if arms.revolute[j]:
                    off -= 2 * math.pi * math.floor(off / (2 * math.pi) + 0.5)
                beyond = max(abs(off) - coverage.half[s], 0.0)
                if beyond < least:
                    least, way = beyond, math.copysign(coverage.rate[j], off)
        if least > worst:
            worst, limiting, side = least, j, way
    off = min(worst / coverage.fade, 1.0)
    return 1 - off * off * (3 - 2 * off), limiting, -6 * off * (1 - off) / coverage.fade * side


@njit(error_model="numpy")
@no_type_check
def move(description: Record, memory: Record, arm: int, q: Array) -> float:
    """Write pose and Jacobian of an arm into `memory.T` and `memory.J`; give the share of the correction.

    See `correction.hybrid_motion`: the slope of the correction is left out of the Jacobian.

    Args:
        description: the calibrated arm.
        memory: to work in.
        arm: NOMINAL, GEOMETRIC, HYBRID (whose joint values are q + Δ) or BLENDED (whose joint values are q).
        q: joint values [rad or m].
    """
    arms = description.arms
    if arm != BLENDED:
        walk(arms, arm, q, memory.axes, memory.T)
        jacobian(arms, memory.axes, memory.T, memory.J)
        return 1.0
    share, limiting, slope = covered(description, q)
    if share == 0.0:
        walk(arms, GEOMETRIC, q, memory.axes, memory.T)
        jacobian(arms, memory.axes, memory.T, memory.J)
        return 0.0
    correct(description, memory, q)
    walk(arms, HYBRID, memory.theta, memory.axes, memory.T)
    jacobian(arms, memory.axes, memory.T, memory.J)
    if share < 1.0:
        _blend(description, memory, q, share, limiting, slope)
    return share


@njit(error_model="numpy")
@no_type_check
def _blend(description: Record, memory: Record, q: Array, share: float, limiting: int, slope: float) -> None:
    """Turn pose and Jacobian of the hybrid arm into those between it and the geometric one."""
    arms, T, J, R = description.arms, memory.T, memory.J, memory.R
    walk(arms, GEOMETRIC, q, memory.axes, memory.T_other)
    jacobian(arms, memory.axes, memory.T_other, memory.J_other)
    T_from = memory.T_other
    for i in range(3):
        for k in range(3):
            R[i, k] = T[i, 0] * T_from[k, 0] + T[i, 1] * T_from[k, 1] + T[i, 2] * T_from[k, 2]
    x, y, z = rotation_vector(R)
    u, v, w = T[0, 3] - T_from[0, 3], T[1, 3] - T_from[1, 3], T[2, 3] - T_from[2, 3]
    for j in range(arms.dof):
        for i in range(6):
            J[i, j] = share * J[i, j] + (1 - share) * memory.J_other[i, j]
    between = memory.error
    between[0], between[1], between[2], between[3], between[4], between[5] = u, v, w, x, y, z
    for i in range(6):
        J[i, limiting] += between[i] * slope
    rotation_from_vector(share * x, share * y, share * z, R)
    for k in range(3):
        for i in range(3):
            T[i, k] = R[i, 0] * T_from[0, k] + R[i, 1] * T_from[1, k] + R[i, 2] * T_from[2, k]
    T[0, 3], T[1, 3], T[2, 3] = T_from[0, 3] + share * u, T_from[1, 3] + share * v, T_from[2, 3] + share * w
