"""The joint correction Δ(q) of one place, on plain numbers."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.compiled.arrays import DRAWN, FIXED, REVOLUTE

Array = Any
Record = Any


@njit(error_model="numpy")
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


@njit(error_model="numpy")
@no_type_check
def _series(correction: Record, dof: int, turning: Array, delta: Array) -> None:
    """Sines and cosines of multiples of every joint's angle, each multiple from the one before, four joints abreast."""
    for j in range(0, dof, 4):
        sin_0, sin_1, sin_2, sin_3 = turning[0, j], turning[0, j + 1], turning[0, j + 2], turning[0, j + 3]
        cos_0, cos_1, cos_2, cos_3 = turning[1, j], turning[1, j + 1], turning[1, j + 2], turning[1, j + 3]
        s_0, s_1, s_2, s_3, c_0, c_1, c_2, c_3 = sin_0, sin_1, sin_2, sin_3, cos_0, cos_1, cos_2, cos_3
        d_0, d_1, d_2, d_3 = 0.0, 0.0, 0.0, 0.0
        for k in range(correction.harmonics):
            d_0 += correction.series[k, 0, j] * s_0 + correction.series[k, 1, j] * c_0
            d_1 += correction.series[k, 0, j + 1] * s_1 + correction.series[k, 1, j + 1] * c_1
            d_2 += correction.series[k, 0, j + 2] * s_2 + correction.series[k, 1, j + 2] * c_2
            d_3 += correction.series[k, 0, j + 3] * s_3 + correction.series[k, 1, j + 3] * c_3
            s_0, c_0 = s_0 * cos_0 + c_0 * sin_0, c_0 * cos_0 - s_0 * sin_0
            s_1, c_1 = s_1 * cos_1 + c_1 * sin_1, c_1 * cos_1 - s_1 * sin_1
            s_2, c_2 = s_2 * cos_2 + c_2 * sin_2, c_2 * cos_2 - s_2 * sin_2
            s_3, c_3 = s_3 * cos_3 + c_3 * sin_3, c_3 * cos_3 - s_3 * sin_3
        delta[j], delta[j + 1], delta[j + 2], delta[j + 3] = d_0, d_1, d_2, d_3


@njit(error_model="numpy")
@no_type_check
def series_slope(correction: Record, dof: int, turning: Array, slope: Array) -> None:
    """Slope of the series of every joint by the joint's own value; the steepest part of a correction.

    Args:
        correction: the weights.
        dof: number of joints.
        turning: sines and cosines, as `joint_correction` leaves them.
        slope: `(DOF,)`, written.
    """
    for j in range(dof):
        sine, cosine, total = turning[0, j], turning[1, j], 0.0
        for k in range(correction.harmonics):
            total += (k + 1) * (correction.series[k, 0, j] * cosine - correction.series[k, 1, j] * sine)
            sine, cosine = (
                sine * turning[1, j] + cosine * turning[0, j],
                cosine * turning[1, j] - sine * turning[0, j],
            )
        slope[j] = correction.rate[j] * total


@njit(error_model="numpy")
@no_type_check
def _add_products(correction: Record, dof: int, phi: Array, delta: Array) -> None:
    """Products of sums of the inputs, four joints abreast."""
    for j in range(0, dof, 4):
        factor = 0
        for unit in range(correction.products):
            p_0, p_1, p_2, p_3 = 1.0, 1.0, 1.0, 1.0
            for _ in range(correction.orders[unit]):
                t_0, t_1 = correction.bias[factor, j], correction.bias[factor, j + 1]
                t_2, t_3 = correction.bias[factor, j + 2], correction.bias[factor, j + 3]
                for i in range(correction.inputs):
                    value = phi[i]
                    t_0 += correction.weight[factor, i, j] * value
                    t_1 += correction.weight[factor, i, j + 1] * value
                    t_2 += correction.weight[factor, i, j + 2] * value
                    t_3 += correction.weight[factor, i, j + 3] * value
                p_0, p_1, p_2, p_3 = p_0 * t_0, p_1 * t_1, p_2 * t_2, p_3 * t_3
                factor += 1
            delta[j] += p_0
            delta[j + 1] += p_1
            delta[j + 2] += p_2
            delta[j + 3] += p_3


@njit(error_model="numpy")
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


@njit(error_model="numpy")
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
