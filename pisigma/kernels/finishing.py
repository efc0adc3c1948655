"""What stands in a solution beside joint values: their turns, what is left of the error, the status."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import BLENDED, GEOMETRIC, HYBRID
from pisigma.kernels.closed_form import nearest_turn, wrap_into_limits
from pisigma.kernels.codes import (
    OUTSIDE_DOMAIN,
    OUTSIDE_LIMITS,
    REACHED,
    SINGULAR,
    SINGULAR_TOLERANCE,
    UNREACHABLE,
)
from pisigma.kernels.damped_step import is_singular
from pisigma.kernels.motion import move
from pisigma.kernels.newton import search
from pisigma.kernels.rotations import pose_error
from pisigma.kernels.rows import copy

Array = Any
Record = Any

_LIMIT = 1e-9


@njit(error_model="numpy")
@no_type_check
def finish(
    description: Record, memory: Record, has_near: bool, reached: bool, found: Array
) -> tuple[bool, int]:
    """Choose the turns, write what is left of the error there and the share; whether it is reached, and the status."""
    arms, q, place = description.arms, memory.solution, 2 * description.arms.dof
    inside = False
    if reached:
        inside, reached = _choose_turns(description, memory, has_near)
    if not reached:
        found[place], found[place + 1], found[place + 2] = math.nan, math.nan, math.nan
        return False, UNREACHABLE
    fresh, share = True, memory.share
    for j in range(arms.dof):
        fresh = fresh and memory.checked[j] == q[j]
    if not fresh:
        share = move(description, memory, BLENDED if arms.hybrid else GEOMETRIC, q)
        pose_error(memory.pose, memory.T, memory.R, memory.error)
    e = memory.error
    found[place] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    found[place + 1] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    found[place + 2] = 2 - share if arms.hybrid else math.nan
    nearest_turn(arms, memory.nominal, q, False)
    if not inside:
        return True, OUTSIDE_LIMITS
    reach = arms.reach[HYBRID if arms.hybrid else GEOMETRIC]
    if is_singular(arms, reach, memory.J, SINGULAR_TOLERANCE, memory):
        return True, SINGULAR
    return True, OUTSIDE_DOMAIN if share < 1.0 else REACHED


@njit(error_model="numpy")
@no_type_check
def _choose_turns(description: Record, memory: Record, has_near: bool) -> tuple[bool, bool]:
    """Bring joints into their limits and near to given values; whether they are inside, and still reach the pose."""
    arms, q = description.arms, memory.solution
    copy(q, memory.q)
    inside = wrap_into_limits(arms, q)
    if has_near:
        nearest_turn(arms, q, memory.near, True)
    turned = False
    for j in range(arms.dof):
        turned = turned or memory.q[j] != q[j]
    if not turned or not arms.hybrid or description.correction.periodic:
        return inside, True
    copy(q, memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return inside, False
    nearest_turn(arms, memory.q, q, False)
    copy(memory.q, q)
    for j in range(arms.dof):
        inside = inside and arms.limits[j, 0] - _LIMIT <= q[j] <= arms.limits[j, 1] + _LIMIT
    return inside, True
