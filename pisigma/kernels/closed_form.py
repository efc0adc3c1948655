"""Closed-form inverses of the nominal arm, branch by branch, on plain numbers.

The formulas and the order of the branches are those of `pisigma.kinematics.closed_form`.
"""

import math
from typing import no_type_check

from numba import njit

from pisigma.kernels.arrays import SCARA, SPHERICAL_WRIST, THREE_PARALLEL
from pisigma.kernels.rotations import wrap
from pisigma.kernels.rows import Array, Record
from pisigma.kinematics.tolerances import LIMIT_TOLERANCE, TILT_TOLERANCE, TRIANGLE_MARGIN


@njit(error_model="numpy")
@no_type_check
def all_branches(
    arms: Record, form: Record, T: Array, only: int, rounding: float, P: Array, q: Array
) -> None:
    """Write joint values of every branch, the first of them NaN where it does not reach the pose.

    Args:
        arms: the arms, for limits.
        form: the nominal arm with canonical twists.
        T: wanted T_base_tool.
        only: the only branch that is wanted; -1 for all. Of the others the first joint value is NaN.
        rounding: relative size below which a cosine beyond 1 or a length counts as rounding of T.
        P: `(4, 4)`, overwritten.
        q: `(8, dof)`, written [rad or m]: in (-pi, pi], or a full turn from there within the limits.
    """
    for branch in range(form.branches):
        q[branch, 0] = math.nan
    _canonical_pose(form, T, P)
    if form.kind == SCARA:
        _scara(form, P, only, rounding, q)
    elif form.kind == SPHERICAL_WRIST:
        _spherical_wrist(form, P, only, rounding, q)
    elif form.kind == THREE_PARALLEL:
        _three_parallel(form, P, only, rounding, q)
    for branch in range(form.branches):
        if math.isnan(q[branch, 0]):
            continue
        for j in range(arms.dof):
            value = form.direction[j] * (form.sign[j] * q[branch, j] - form.offset[j])
            q[branch, j] = wrap(value) if arms.revolute[j] else value
        wrap_into_limits(arms, q[branch])


@njit(error_model="numpy")
@no_type_check
def wrap_into_limits(arms: Record, q: Array) -> bool:
    """Move joints by full turns into their limits where that is possible; whether all are inside."""
    all_inside = True
    for j in range(arms.dof):
        lower, upper = arms.limits[j, 0] - LIMIT_TOLERANCE, arms.limits[j, 1] + LIMIT_TOLERANCE
        if lower <= q[j] <= upper:
            continue
        moved = q[j]
        if arms.revolute[j] and q[j] < lower:
            moved += 2 * math.pi * math.ceil((lower - q[j]) / (2 * math.pi))
        elif arms.revolute[j]:
            moved -= 2 * math.pi * math.ceil((q[j] - upper) / (2 * math.pi))
        if lower <= moved <= upper:
            q[j] = moved
        else:
            all_inside = False
    return all_inside


@njit(error_model="numpy")
@no_type_check
def nearest_turn(arms: Record, q: Array, near: Array, within_limits: bool) -> None:
    """Move revolute joints by full turns as near to given values as they can come."""
    for j in range(arms.dof):
        if not arms.revolute[j]:
            continue
        turns = math.floor((near[j] - q[j]) / (2 * math.pi) + 0.5)
        if within_limits:
            lowest = math.ceil((arms.limits[j, 0] - LIMIT_TOLERANCE - q[j]) / (2 * math.pi))
            highest = math.floor((arms.limits[j, 1] + LIMIT_TOLERANCE - q[j]) / (2 * math.pi))
            turns = max(min(turns, highest), lowest) if lowest <= highest else 0.0
        if turns != 0.0:
            q[j] += 2 * math.pi * turns


@njit(error_model="numpy")
@no_type_check
def _canonical_pose(form: Record, T: Array, P: Array) -> None:
    """Pose of the last joint's frame, turned, in the frame before the first joint: `first · T · last`."""
    for i in range(3):
        for k in range(4):
            P[3, k] = form.first[i, 0] * T[0, k] + form.first[i, 1] * T[1, k] + form.first[i, 2] * T[2, k]
        P[3, 3] += form.first[i, 3]
        for k in range(4):
            P[i, k] = P[3, 0] * form.last[0, k] + P[3, 1] * form.last[1, k] + P[3, 2] * form.last[2, k]
        P[i, 3] += P[3, 3]


@njit(error_model="numpy")
@no_type_check
def _two_link(
    x: float, y: float, a: float, b: float, elbow_sign: float, free: float, rounding: float
) -> tuple[float, float, bool]:
    """Angles of two links that end in a point, and whether it is within reach."""
    cosine = (x * x + y * y - (a * a + b * b)) / (2 * a * b)
    reached = abs(cosine) <= 1 + rounding
    cosine = min(max(cosine, -1.0), 1.0)
    sine = elbow_sign * math.sqrt((1 - cosine) * (1 + cosine))
    first = free
    if math.sqrt(x * x + y * y) > rounding * (abs(a) + b):
        first = math.atan2(y, x) - math.atan2(b * sine, a + b * cosine)
    return first, math.atan2(sine, cosine), reached


@njit(error_model="numpy")
@no_type_check
def _scara(form: Record, P: Array, only: int, rounding: float, q: Array) -> None:
    if math.hypot(P[0, 2], P[1, 2]) > max(TILT_TOLERANCE, rounding) or P[2, 2] <= 0:
        return
    x, y = form.a[1] + form.a[2] * math.cos(form.theta[2]), form.a[2] * math.sin(form.theta[2])
    length, angle = math.hypot(x, y), math.atan2(y, x)
    zero = form.sign[0] * form.offset[0]
    for branch in range(2):
        if only >= 0 and branch != only:
            continue
        first, elbow, reached = _two_link(
            P[0, 3], P[1, 3], form.a[0], length, 1.0 - 2 * branch, zero, rounding
        )
        if reached:
            t_2 = elbow - angle
            q[branch, 0], q[branch, 1] = first, t_2
            q[branch, 2] = P[2, 3] - form.d[0] - form.d[1]
            q[branch, 3] = math.atan2(P[1, 0], P[0, 0]) - first - t_2 - form.theta[2]


@njit(error_model="numpy")
@no_type_check
def _first_joint(
    P: Array, side: float, scale: float, zero: float, rounding: float
) -> tuple[float, float, bool, bool]:
    """Distance ahead of axis 1, azimuth, whether there is such a joint value, whether it is free."""
    x, y = P[0, 3], P[1, 3]
    square = x * x + y * y - side * side
    on_axis = math.hypot(x, y) <= rounding * scale
    azimuth = zero if on_axis else math.atan2(y, x)
    return math.sqrt(max(square, 0.0)), azimuth, square >= -rounding * scale * scale, on_axis


@njit(error_model="numpy")
@no_type_check
def _spherical_wrist(form: Record, P: Array, only: int, rounding: float, q: Array) -> None:
    a, d = form.a, form.d
    forearm, side = math.hypot(a[2], d[3]), d[1] + d[2]
    scale = abs(a[0]) + abs(a[1]) + forearm + abs(side)
    far, azimuth, beside, on_axis = _first_joint(P, side, scale, form.sign[0] * form.offset[0], rounding)
    if not beside:
        return
    for pair in range(4):
        if only >= 0 and only // 2 != pair:
            continue
        shoulder, elbow = 1.0 - 2 * (pair // 2), 1.0 - 2 * (pair % 2)
        ahead = shoulder * far
        t_1 = azimuth - math.atan2(side, ahead)
        if shoulder < 0 and on_axis:
            t_1 = azimuth - math.pi
        upwards = shoulder * elbow * math.copysign(1.0, a[1])
        zero = form.sign[1] * form.offset[1]
        t_2, bend, reached = _two_link(ahead - a[0], d[0] - P[2, 3], a[1], forearm, upwards, zero, rounding)
        if reached:
            _spherical_joints(form, P, t_1, t_2, bend - math.atan2(d[3], a[2]), only, 2 * pair, rounding, q)


@njit(error_model="numpy")
@no_type_check
def _spherical_joints(
    form: Record,
    P: Array,
    t_1: float,
    t_2: float,
    t_3: float,
    only: int,
    branch: int,
    rounding: float,
    q: Array,
) -> None:
    """Joints 4 to 6, both flips, from `M = R_03^T · R = RotZ(t_4) RotY(-t_5) RotZ(t_6)`."""
    c_1, s_1 = math.cos(t_1), math.sin(t_1)
    c, s = math.cos(t_2 + t_3), math.sin(t_2 + t_3)
    xx, xy, xz = c_1 * c, s_1 * c, -s
    zx, zy, zz = -c_1 * s, -s_1 * s, -c
    m_02 = xx * P[0, 2] + xy * P[1, 2] + xz * P[2, 2]
    m_12 = s_1 * P[0, 2] - c_1 * P[1, 2]
    m_22 = zx * P[0, 2] + zy * P[1, 2] + zz * P[2, 2]
    m_00 = xx * P[0, 0] + xy * P[1, 0] + xz * P[2, 0]
    m_01 = xx * P[0, 1] + xy * P[1, 1] + xz * P[2, 1]
    m_10, m_11 = s_1 * P[0, 0] - c_1 * P[1, 0], s_1 * P[0, 1] - c_1 * P[1, 1]
    sine = math.hypot(m_02, m_12)
    t_4 = form.sign[3] * form.offset[3] if sine <= rounding else math.atan2(-m_12, -m_02)
    t_5 = math.atan2(sine, m_22)
    cos, sin = math.cos(t_4), math.sin(t_4)
    t_6 = math.atan2(cos * m_10 - sin * m_00, cos * m_11 - sin * m_01)
    for flip in range(2):
        if only < 0 or only == branch + flip:
            out, turn = q[branch + flip], math.pi * flip
            out[0], out[1], out[2] = t_1, t_2, t_3
            out[3], out[4], out[5] = t_4 + turn, t_5 * (1.0 - 2 * flip), t_6 + turn


@njit(error_model="numpy")
@no_type_check
def _three_parallel(form: Record, P: Array, only: int, rounding: float, q: Array) -> None:
    a, d = form.a, form.d
    side = d[1] + d[2] + d[3]
    scale = abs(a[0]) + abs(a[1]) + abs(a[2]) + math.hypot(a[3], d[4]) + abs(side)
    far, azimuth, beside, on_axis = _first_joint(P, side, scale, form.sign[0] * form.offset[0], rounding)
    if not beside:
        return
    for shoulder in range(2):
        if only >= 0 and only // 4 != shoulder:
            continue
        ahead = far * (1.0 - 2 * shoulder)
        t_1 = azimuth + math.atan2(side, ahead)
        if shoulder == 1 and on_axis:
            t_1 = azimuth + math.pi
        s_1, c_1 = math.sin(t_1), math.cos(t_1)
        u, v, w = s_1 * P[0, 0] - c_1 * P[1, 0], s_1 * P[0, 1] - c_1 * P[1, 1], s_1 * P[0, 2] - c_1 * P[1, 2]
        sine = math.hypot(u, v)
        for wrist in range(2):
            if only >= 0 and only % 2 != wrist:
                continue
            flip = 1.0 - 2 * wrist
            free = sine <= rounding
            t_6 = form.sign[5] * form.offset[5] if free else math.atan2(-flip * v, flip * u)
            t_5 = flip * math.atan2(sine, w)
            for elbow in range(2):
                branch = 4 * shoulder + 2 * elbow + wrist
                if only < 0 or only == branch:
                    upwards = -(1.0 - 2 * shoulder) * (1.0 - 2 * elbow) * math.copysign(1.0, a[1])
                    _plane_joints(form, P, t_1, t_5, t_6, ahead - a[0], upwards, free, rounding, q[branch])


@njit(error_model="numpy")
@no_type_check
def _plane_joints(
    form: Record,
    P: Array,
    t_1: float,
    t_5: float,
    t_6: float,
    x: float,
    upwards: float,
    free: bool,
    rounding: float,
    q: Array,
) -> None:
    """Joints 2 to 4: the two links that carry axis 4; joint 6 of a straight wrist may turn for them."""
    a, y, zero = form.a, P[2, 3] - form.d[0], form.sign[1] * form.offset[1]
    along, across, b = a[3], -form.d[4], abs(a[2])
    for attempt in range(2):
        s_6, c_6 = math.sin(t_6), math.cos(t_6)
        u, v = -s_6 * P[0, 0] - c_6 * P[0, 1], -s_6 * P[1, 0] - c_6 * P[1, 1]
        t_234 = math.atan2(math.cos(t_1) * u + math.sin(t_1) * v, s_6 * P[2, 0] + c_6 * P[2, 1])
        c, s = math.cos(t_234), math.sin(t_234)
        first, bend, reached = _two_link(
            x - (c * along - s * across), y - (s * along + c * across), a[1], b, upwards, zero, rounding
        )
        if reached:
            t_3 = bend - (math.pi if a[2] < 0 else 0.0)
            q[0], q[1], q[2] = t_1, first, t_3
            q[3], q[4], q[5] = t_234 - first - t_3, t_5, t_6
            return
        hand, far = math.hypot(along, across), math.hypot(x, y)
        if attempt == 1 or not free or hand == 0.0:
            return
        turn = t_234 + math.atan2(across, along) - math.atan2(y, x)
        nearest, farthest = (
            abs(abs(a[1]) - b) + TRIANGLE_MARGIN * (abs(a[1]) + b),
            (abs(a[1]) + b) * (1 - TRIANGLE_MARGIN),
        )
        square = far * far + hand * hand - 2 * far * hand * math.cos(turn)
        square = min(max(square, nearest * nearest), farthest * farthest)
        cosine = (far * far + hand * hand - square) / (2 * (far if far > 0 else 1.0) * hand)
        change = math.copysign(math.acos(min(max(cosine, -1.0), 1.0)), math.sin(turn)) - turn
        t_6 -= math.copysign(1.0, math.cos(t_5)) * change
