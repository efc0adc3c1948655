"""What a network adds to the nominal joint values of a pose, and how far the pose is from training rows.

The formulas are those of `network.correction_network` and `correction.domain`, on plain numbers.
"""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import ANGLE, SINE

Array = Any
Record = Any

SETTLED, ROUNDS, ACCEPTED = 1e-12, 100, 1e-9
"""See `correction.calibrated_model`: joint values [rad or m] have settled, after so many rounds at most; or nearly."""


@njit(error_model="numpy")
@no_type_check
def network_correction(description: Record, memory: Record, T: Array, q: Array) -> None:
    """Write the correction of nominal joint values into `memory.delta` and scaled inputs into `memory.seen`.

    Args:
        description: the arm and its network.
        memory: to work in.
        T: `(3 or 4, 4)`: T_base_tool.
        q: nominal joint values [rad or m].
    """
    net, x = description.network, memory.seen
    for i in range(net.inputs):
        x[i] = (_input(description, memory, T, q, i) - net.offset[i]) / net.scale[i]
    for j in range(description.arms.dof):
        memory.delta[j] = 0.0
        group = net.group[j]
        if group < 0:
            continue
        total, factor, first = 0.0, 0, net.first[group]
        for unit in range(net.products[group]):
            product = 1.0
            for _ in range(net.orders[group, unit]):
                value = net.bias[j, factor]
                for i in range(net.first[group + 1] - first):
                    value += net.weight[j, factor, i] * x[first + i]
                product *= value
                factor += 1
            total += product
        memory.delta[j] = net.output_offset[j] + net.output_scale[j] * total


@njit(error_model="numpy")
@no_type_check
def _input(description: Record, memory: Record, T: Array, q: Array, index: int) -> float:
    """One input, not scaled; see `network.inputs.Inputs`."""
    net = description.network
    source = net.source[index]
    if source < 3:
        return T[source, 3]
    if source < ANGLE:
        group = 0
        while index >= net.first[group + 1]:
            group += 1
        _roll_pitch_yaw(net.reference[group], T, memory.R, memory.angles)
        return memory.angles[source - 3]
    angle = 0.0
    for j in range(description.arms.dof):
        angle += net.factors[index, j] * q[j]
    if source == ANGLE:
        return angle
    return math.sin(angle) if source == SINE else math.cos(angle)


@njit(error_model="numpy")
@no_type_check
def _roll_pitch_yaw(reference: Array, T: Array, R: Array, angles: Array) -> None:
    """Angles of a rotation seen from a reference, as `se3.rpy_from_rotation` gives them."""
    for i in range(3):
        for k in range(3):
            R[i, k] = reference[0, i] * T[0, k] + reference[1, i] * T[1, k] + reference[2, i] * T[2, k]
    horizontal = R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]
    if horizontal > 1e-24:
        angles[0] = math.atan2(R[1, 0], R[0, 0])
        angles[1] = math.atan2(-R[2, 0], math.sqrt(horizontal))
        angles[2] = math.atan2(R[2, 1], R[2, 2])
    else:
        angles[0] = math.atan2(-R[0, 1], R[1, 1])
        angles[1] = math.atan2(-R[2, 0], 0.0)
        angles[2] = 0.0


@njit(error_model="numpy")
@no_type_check
def domain_measure(description: Record, memory: Record) -> float:
    """Distance of the inputs in `memory.seen` to the nearest training row over the radius; NaN without a domain.

    Most rows are farther by the coarse coordinates alone than the nearest by all of them.
    """
    net, distance, n = description.network, memory.distance, description.network.samples
    if n == 0:
        return math.nan
    for s in range(n):
        distance[s] = 0.0
    for c in range(net.coarse):
        value, start = memory.seen[net.column[c]] * net.times[c], c * n
        for s in range(n):
            off = net.rows[start + s] - value
            distance[s] += off * off
    least = math.inf
    for s in range(n):
        total = distance[s]
        if total < least:
            for c in range(net.coarse, net.columns):
                off = net.rows[c * n + s] - memory.seen[net.column[c]] * net.times[c]
                total += off * off
            least = min(least, total)
    return math.sqrt(least) / net.radius
