"""Where the tool of an arm is and how it moves, with the correction, on plain numbers."""

import math

from pisigma.kernels.arrays import CORRECTED, IDENTIFIED
from pisigma.kernels.chain import jacobian, walk
from pisigma.kernels.joint_correction import joint_correction
from pisigma.kernels.rows import Array, Record, kernel


@kernel
def correct(description: Record, memory: Record, q: Array) -> None:
    """Write Δ(q) into `memory.delta` and q + Δ(q) into `memory.theta`."""
    arms, correction = description.arms, description.correction
    joint_correction(arms, correction, memory, q)
    for j in range(arms.dof):
        memory.theta[j] = q[j] + memory.delta[j]


@kernel
def beyond_measured(description: Record, q: Array) -> float:
    """Angle [rad] by which the joint that is farthest out lies beyond its measured values; see `JointCoverage`."""
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

    See `model.hybrid_motion`: the slope of the correction is left out of the Jacobian.

    Args:
        description: the calibrated arm.
        memory: to work in.
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
