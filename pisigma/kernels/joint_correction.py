"""The joint correction Δ(q) of one place, on plain numbers."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import DRAWN, FIXED, REVOLUTE

Array = Any
Record = Any


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def joint_correction(
    arms: Record, correction: Record, q: Array, turning: Array, phi: Array, delta: Array
) -> None:
    """Corrections to add to joint values, without gravity's; see `network.joint_correction.JointCorrection`.

    Args:
        arms: the arms.
        correction: the weights.
        q: joint values [rad or m].
        turning: `(2, DOF)`, written: sines and cosines of the joints' angles.
        phi: `(INPUTS,)`, overwritten.
        delta: `(DOF,)`, written [rad or m].
    """
    dof, revolute = arms.dof, 0
    for j in range(dof):
        angle = correction.rate[j] * q[j]
        turning[0, j], turning[1, j] = math.sin(angle), math.cos(angle)
        revolute += arms.revolute[j]
    i, k = 0, 2 * revolute
    for j in range(dof):
        if arms.revolute[j]:
            phi[i], phi[revolute + i] = turning[0, j], turning[1, j]
            i += 1
        else:
            phi[k] = (q[j] - correction.middle[j]) / correction.half[j]
            k += 1
    _series(correction, dof, turning, delta)
    if correction.has_scaled:
        for j in range(dof):
            for i in range(dof):
                delta[j] += correction.scaled[j, i] * (q[i] - correction.middle[i]) / correction.half[i]
    if correction.has_units:
        for j in range(dof):
            for i in range(correction.inputs):
                delta[j] += correction.units[j, i] * phi[i]
    _add_products(correction, dof, phi, delta)


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def _series(correction: Record, dof: int, turning: Array, delta: Array) -> None:
    """Sums of sines and cosines of multiples of every joint's angle, four joints abreast.

    Source: C. W. Clenshaw, A note on the summation of Chebyshev series, 1955: from the last multiple to the first,
    `b_k = w_k + 2 cos(θ) b_k+1 - b_k+2`; the sum is `b_1 cos(θ) - b_2` of cosines and `b_1 sin(θ)` of sines.
    """
    for j in range(0, dof, 4):
        sine, cosine, total = turning[0, j : j + 4], turning[1, j : j + 4], delta[j : j + 4]
        weights = correction.series[:, :, j : j + 4]
        t_0, t_1, t_2, t_3 = 2 * cosine[0], 2 * cosine[1], 2 * cosine[2], 2 * cosine[3]
        s_0, s_1, s_2, s_3, c_0, c_1, c_2, c_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u_0, u_1, u_2, u_3, v_0, v_1, v_2, v_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(correction.harmonics - 1, -1, -1):
            w = weights[k]
            u_0, s_0 = s_0, t_0 * s_0 + (w[0, 0] - u_0)
            u_1, s_1 = s_1, t_1 * s_1 + (w[0, 1] - u_1)
            u_2, s_2 = s_2, t_2 * s_2 + (w[0, 2] - u_2)
            u_3, s_3 = s_3, t_3 * s_3 + (w[0, 3] - u_3)
            v_0, c_0 = c_0, t_0 * c_0 + (w[1, 0] - v_0)
            v_1, c_1 = c_1, t_1 * c_1 + (w[1, 1] - v_1)
            v_2, c_2 = c_2, t_2 * c_2 + (w[1, 2] - v_2)
            v_3, c_3 = c_3, t_3 * c_3 + (w[1, 3] - v_3)
        total[0] = sine[0] * s_0 + (cosine[0] * c_0 - v_0)
        total[1] = sine[1] * s_1 + (cosine[1] * c_1 - v_1)
        total[2] = sine[2] * s_2 + (cosine[2] * c_2 - v_2)
        total[3] = sine[3] * s_3 + (cosine[3] * c_3 - v_3)


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def series_slope(correction: Record, dof: int, turning: Array, slope: Array) -> None:
    """Slope of the series of every joint by the joint's own value; the steepest part of a correction.

    Args:
        correction: the weights.
        dof: number of joints.
        turning: sines and cosines, as `joint_correction` leaves them.
        slope: `(DOF,)`, written.
    """
    for j in range(0, dof, 4):
        sine, cosine, total = turning[0, j : j + 4], turning[1, j : j + 4], slope[j : j + 4]
        weights, rate = correction.series[:, :, j : j + 4], correction.rate[j : j + 4]
        t_0, t_1, t_2, t_3 = 2 * cosine[0], 2 * cosine[1], 2 * cosine[2], 2 * cosine[3]
        s_0, s_1, s_2, s_3, c_0, c_1, c_2, c_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u_0, u_1, u_2, u_3, v_0, v_1, v_2, v_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(correction.harmonics - 1, -1, -1):
            w, times = weights[k], k + 1.0
            u_0, s_0 = s_0, t_0 * s_0 - (times * w[1, 0] + u_0)
            u_1, s_1 = s_1, t_1 * s_1 - (times * w[1, 1] + u_1)
            u_2, s_2 = s_2, t_2 * s_2 - (times * w[1, 2] + u_2)
            u_3, s_3 = s_3, t_3 * s_3 - (times * w[1, 3] + u_3)
            v_0, c_0 = c_0, t_0 * c_0 + (times * w[0, 0] - v_0)
            v_1, c_1 = c_1, t_1 * c_1 + (times * w[0, 1] - v_1)
            v_2, c_2 = c_2, t_2 * c_2 + (times * w[0, 2] - v_2)
            v_3, c_3 = c_3, t_3 * c_3 + (times * w[0, 3] - v_3)
        total[0] = rate[0] * (sine[0] * s_0 + (cosine[0] * c_0 - v_0))
        total[1] = rate[1] * (sine[1] * s_1 + (cosine[1] * c_1 - v_1))
        total[2] = rate[2] * (sine[2] * s_2 + (cosine[2] * c_2 - v_2))
        total[3] = rate[3] * (sine[3] * s_3 + (cosine[3] * c_3 - v_3))


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def _add_products(correction: Record, dof: int, phi: Array, delta: Array) -> None:
    """Products of sums of the inputs, four joints abreast."""
    for j in range(0, dof, 4):
        total, factor = delta[j : j + 4], 0
        weights, biases = correction.weight[:, :, j : j + 4], correction.bias[:, j : j + 4]
        for unit in range(correction.products):
            p_0, p_1, p_2, p_3 = 1.0, 1.0, 1.0, 1.0
            for _ in range(correction.orders[unit]):
                bias = biases[factor]
                t_0, t_1, t_2, t_3 = bias[0], bias[1], bias[2], bias[3]
                for i in range(correction.inputs):
                    value, w = phi[i], weights[factor, i]
                    t_0 += w[0] * value
                    t_1 += w[1] * value
                    t_2 += w[2] * value
                    t_3 += w[3] * value
                p_0, p_1, p_2, p_3 = p_0 * t_0, p_1 * t_1, p_2 * t_2, p_3 * t_3
                factor += 1
            total[0] += p_0
            total[1] += p_1
            total[2] += p_2
            total[3] += p_3


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def add_gravity(
    arms: Record, correction: Record, q: Array, turning: Array, frames: Array, delta: Array
) -> None:
    """Add what unknown masses turn the joints; see `network.features.GravityTorques`.

    Torque j is `Σ_k z_j · (arm_jk × g)`, with the weights of row k in `arm_jk`, and `z · (a × g) = a · (g × z)`.

    Args:
        arms: the arms.
        correction: the weights.
        q: joint values [rad or m].
        turning: sines and cosines of the joints' angles, as `joint_correction` leaves them.
        frames: `(dof, 18)`, overwritten: axis and origin of a joint, axes and origin of its row's frame.
        delta: `(dof,)`, added to [rad or m].
    """
    _walk_drawn(arms, correction, q, turning, frames)
    gx, gy, gz = correction.gravity[0], correction.gravity[1], correction.gravity[2]
    dof = arms.dof
    for j in range(dof):
        own, sign = frames[j], arms.direction[j]
        zx, zy, zz = sign * own[0], sign * own[1], sign * own[2]
        u, v, w = 0.0, 0.0, 0.0
        force = 0.0
        for k in range(j, dof):
            weight, frame = correction.masses[j, k], frames[k]
            force += weight[0]
            u += weight[0] * (frame[15] - own[3])
            v += weight[0] * (frame[16] - own[4])
            w += weight[0] * (frame[17] - own[5])
            u += weight[1] * frame[6] + weight[2] * frame[9] + weight[3] * frame[12]
            v += weight[1] * frame[7] + weight[2] * frame[10] + weight[3] * frame[13]
            w += weight[1] * frame[8] + weight[2] * frame[11] + weight[3] * frame[14]
        if arms.revolute[j]:
            delta[j] += u * (gy * zz - gz * zy) + v * (gz * zx - gx * zz) + w * (gx * zy - gy * zx)
        else:
            delta[j] += force * (zx * gx + zy * gy + zz * gz)


@njit(error_model="numpy", fastmath={"contract"})
@no_type_check
def _walk_drawn(arms: Record, correction: Record, q: Array, turning: Array, frames: Array) -> None:
    """Frames of the arm as drawn, in the frame of its first row."""
    ax, ay, az, ap = 1.0, 0.0, 0.0, 0.0
    bx, by, bz, bp = 0.0, 1.0, 0.0, 0.0
    cx, cy, cz, cp = 0.0, 0.0, 1.0, 0.0
    joint = 0
    for i in range(arms.rows_used):
        row, kind = arms.rows[DRAWN, i], arms.kind[i]
        d, cos, sin = row[1], row[7], row[8]
        if kind == REVOLUTE:
            sign = arms.direction[joint]
            s, c = sign * turning[0, joint], turning[1, joint]
            cos, sin = cos * c - sin * s, sin * c + cos * s
        elif kind != FIXED:
            d += arms.direction[joint] * q[joint]
        if kind != FIXED:
            frame = frames[joint]
            frame[0], frame[1], frame[2] = az, bz, cz
            frame[3], frame[4], frame[5] = ap, bp, cp
        ax, ay = cos * ax + sin * ay, cos * ay - sin * ax
        bx, by = cos * bx + sin * by, cos * by - sin * bx
        cx, cy = cos * cx + sin * cy, cos * cy - sin * cx
        ap += row[2] * ax + d * az
        bp += row[2] * bx + d * bz
        cp += row[2] * cx + d * cz
        cos, sin = row[3], row[4]
        ay, az = cos * ay + sin * az, cos * az - sin * ay
        by, bz = cos * by + sin * bz, cos * bz - sin * by
        cy, cz = cos * cy + sin * cz, cos * cz - sin * cy
        cos, sin = row[5], row[6]
        az, ax = cos * az + sin * ax, cos * ax - sin * az
        bz, bx = cos * bz + sin * bx, cos * bx - sin * bz
        cz, cx = cos * cz + sin * cx, cos * cx - sin * cz
        if kind != FIXED:
            frame = frames[joint]
            frame[6], frame[7], frame[8] = ax, bx, cx
            frame[9], frame[10], frame[11] = ay, by, cy
            frame[12], frame[13], frame[14] = az, bz, cz
            frame[15], frame[16], frame[17] = ap, bp, cp
            joint += 1
