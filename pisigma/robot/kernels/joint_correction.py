"""The joint correction Δ(q), and pose and Jacobian of an arm with joint correction, on plain numbers."""

import math
from collections.abc import Callable, Iterable
from typing import Any

from pisigma.robot.kernels.arrays import CORRECTED, FIXED, IDENTIFIED, NOMINAL_WITHOUT_BASE, REVOLUTE
from pisigma.robot.kernels.chain import jacobian, walk
from pisigma.robot.kernels.forms import FORMS, compiled_plain
from pisigma.robot.kernels.rows import Array, Record, contracted_kernel, kernel


def _chained(functions: Iterable[Callable[..., None] | None]) -> Any:
    """Return one function that calls those of the features of a correction; see `CompiledForm`."""

    @kernel
    def chain(arms: Record, correction: Record, memory: Record, q: Array) -> None:
        pass

    for index, function in enumerate(functions):
        if function is not None:
            compiled = compiled_plain(function, contracted_kernel)
            chain = _then(chain, compiled, index)
    return chain


def _then(chain: Any, function: Any, index: int) -> Any:
    @kernel
    def both(arms: Record, correction: Record, memory: Record, q: Array) -> None:
        chain(arms, correction, memory, q)
        first = correction.first[index]
        if first >= 0:
            function(arms, correction, first, memory, q)

    return both


_add_features = _chained(form.add for form in FORMS.values())
_add_slopes = _chained(form.add_slope for form in FORMS.values())


@contracted_kernel
def joint_correction(arms: Record, correction: Record, memory: Record, q: Array) -> None:
    """Write corrections to add to joint values [rad or m] into `memory.delta`; see `JointCorrection`.

    Args:
        arms: the arms.
        correction: the weights.
        memory: working memory; `approach` is read, `turning`, `phi` and `frames` are written.
        q: joint values [rad or m].
    """
    dof, revolute, turning, phi = arms.dof, 0, memory.turning, memory.phi
    for j in range(dof):
        angle = correction.rate[j] * q[j]
        turning[0, j], turning[1, j] = math.sin(angle), math.cos(angle)
        memory.delta[j] = 0.0
        revolute += arms.revolute[j]
    i, k = 0, 2 * revolute
    for j in range(dof):
        if arms.revolute[j]:
            phi[i], phi[revolute + i] = turning[0, j], turning[1, j]
            i += 1
        else:
            phi[k] = (q[j] - correction.middle[j]) / correction.half[j]
            k += 1
    if correction.frames:
        _walk_nominal(arms, q, turning, memory.frames)
    _add_features(arms, correction, memory, q)
    _add_products(correction, dof, phi, memory.delta)


@kernel
def correction_slope(arms: Record, correction: Record, memory: Record, q: Array) -> None:
    """Write large derivatives of every joint's correction with respect to its joint value into `memory.slope`.

    Args:
        arms: the arms.
        correction: the weights.
        memory: working memory with sines and cosines written by `joint_correction`.
        q: joint values [rad or m].
    """
    for j in range(arms.dof):
        memory.slope[j] = 0.0
    _add_slopes(arms, correction, memory, q)


@contracted_kernel
def _add_products(correction: Record, dof: int, phi: Array, delta: Array) -> None:
    """Add the product units, products of sums of the inputs, for four joints at a time."""
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


@contracted_kernel
def _walk_nominal(arms: Record, q: Array, turning: Array, frames: Array) -> None:
    """Write axis and origin of every joint, and axes and origin of its row's frame, of the nominal arm.

    All vectors are in the frame of the arm's first row. `frames` is `(dof, 18)`.
    """
    ax, ay, az, ap = 1.0, 0.0, 0.0, 0.0
    bx, by, bz, bp = 0.0, 1.0, 0.0, 0.0
    cx, cy, cz, cp = 0.0, 0.0, 1.0, 0.0
    joint = 0
    for i in range(arms.rows_used):
        row, kind = arms.rows[NOMINAL_WITHOUT_BASE, i], arms.kind[i]
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


@kernel
def correct(description: Record, memory: Record, q: Array) -> None:
    """Write Δ(q) into `memory.delta` and q + Δ(q) into `memory.theta`."""
    arms, correction = description.arms, description.correction
    joint_correction(arms, correction, memory, q)
    for j in range(arms.dof):
        memory.theta[j] = q[j] + memory.delta[j]


@kernel
def beyond_measured(description: Record, q: Array) -> float:
    """Return the largest excess of a joint over its measured values [rad]; see `JointCoverage`."""
    coverage, arms, worst = description.coverage, description.arms, 0.0
    for j in range(arms.dof):
        angle, least = q[j] * coverage.rate[j], math.inf
        for s in range(coverage.stretches):
            if coverage.joint[s] == j:
                off = angle - coverage.middle[s]
                if arms.revolute[j]:
                    off -= 2 * math.pi * math.floor(off / (2 * math.pi) + 0.5)
                least = min(least, max(abs(off) - coverage.half[s], 0.0))
        worst = max(worst, least)
    return worst


@kernel
def move(description: Record, memory: Record, arm: int, q: Array) -> None:
    """Write pose and Jacobian of an arm into `memory.T` and `memory.J`.

    The derivative of the correction is omitted from the Jacobian, see `model.hybrid_motion`.

    Args:
        description: the calibrated arm.
        memory: working memory.
        arm: NOMINAL, IDENTIFIED, or CORRECTED, which adds the correction to the joint values.
        q: joint values [rad or m].
    """
    arms = description.arms
    if arm == CORRECTED:
        correct(description, memory, q)
        walk(arms, IDENTIFIED, memory.theta, memory.axes, memory.T)
    else:
        walk(arms, arm, q, memory.axes, memory.T)
    jacobian(arms, memory.axes, memory.T, memory.J)
