"""Corrected inverse kinematics of one pose, on plain numbers: what `correction.corrected_ik` does for batches."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.compiled.arrays import BLENDED, GEOMETRIC, HYBRID, NO_CLOSED_FORM, NOMINAL
from pisigma.compiled.closed_form import all_branches, turn_into_limits, turn_near
from pisigma.compiled.damped_step import is_singular
from pisigma.compiled.motion import move
from pisigma.compiled.newton import ACCEPTED, TOLERANCE, newton, search
from pisigma.compiled.recovery import branch_of, nearest_starts, recover, within_reach
from pisigma.compiled.rotations import pose_error, wrap
from pisigma.kinematics.status import Status

Array = Any
Record = Any

REACHED, SINGULAR, OUTSIDE_LIMITS = (
    int(Status.REACHED),
    int(Status.SINGULAR),
    int(Status.OUTSIDE_JOINT_LIMITS),
)
OUTSIDE_DOMAIN, UNREACHABLE = int(Status.OUTSIDE_DOMAIN), int(Status.UNREACHABLE)
SINGULAR_TOLERANCE = 1e-5
"""A solution is SINGULAR where the smallest singular value is smaller: see `kinematics.numeric`."""
_MARGIN = 1.0
"""[rad or m] Corrections are smaller, so that branches that are farther off need not be corrected to be compared."""
AWAY = 0.1
"""[rad or m] A solution farther from where it was to be near to may not be the one that was meant."""
_LIMIT = 1e-9


@njit(error_model="numpy")
@no_type_check
def solve_pose(description: Record, memory: Record, has_near: bool, branch: int, found: Array) -> None:
    """Find commanded joint values for the pose in `memory.pose`.

    Args:
        description: the calibrated arm.
        memory: to work in, with the wanted T_base_tool, checked, and the joint values to stay near to.
        has_near: whether these count.
        branch: index of the branch wanted, or -1.
        found: `(2 · dof + 5,)`, written: commanded and nominal joint values [rad or m], distance [m] and angle [rad]
            from the pose, share of the correction, status and branch.
    """
    form, chosen = description.closed_form, -1
    wanted = form.default if branch < 0 else branch
    memory.nominal[:] = math.nan
    if not within_reach(description, memory.pose):
        pass
    elif form.kind == NO_CLOSED_FORM:
        chosen = _solve_without_branches(description, memory, has_near)
    else:
        free = has_near and branch < 0
        all_branches(
            description.arms, form, memory.pose, -1 if free else wanted, memory.wanted, memory.branches
        )
        chosen = _solve_branches(description, memory, free)
        if chosen >= 0:
            memory.nominal[:] = memory.branches[chosen]
        else:
            chosen = recover(description, memory, wanted, branch < 0)
        if free:
            chosen = _continue(description, memory, chosen)
    reached, status = _finish(description, memory, has_near, chosen >= 0, found)
    dof = description.arms.dof
    for j in range(dof):
        found[j] = memory.solution[j] if reached else math.nan
        found[dof + j] = memory.nominal[j] if reached else math.nan
    found[2 * dof + 3], found[2 * dof + 4] = status, wanted if chosen < 0 else chosen


@njit(error_model="numpy")
@no_type_check
def _solve_branches(description: Record, memory: Record, free: bool) -> int:
    """Solve from the nominal joint values of the branches on; the best goes to `memory.solution`, its index is given.

    Where any branch will do, the nearest of those that reach the pose inside the limits is best, else of the others.
    """
    arms, others = description.arms, memory.others
    others[:, :] = memory.branches
    best, best_rank, best_distance = -1, 2, math.inf
    while True:
        branch, distance = _nearest(description, memory, free)
        if branch < 0 or (best_rank == 0 and math.sqrt(distance) - _MARGIN > math.sqrt(best_distance)):
            break
        others[branch, 0] = math.nan
        memory.q[:] = memory.branches[branch]
        if not search(description, memory, memory.pose, memory.q):
            continue
        for j in range(arms.dof):
            if arms.revolute[j]:
                memory.q[j] = memory.branches[branch, j] + wrap(memory.q[j] - memory.branches[branch, j])
        if not free:
            memory.solution[:] = memory.q
            return branch
        memory.trial[:] = memory.q
        rank = 0 if turn_into_limits(arms, memory.trial) else 1
        turn_near(arms, memory.trial, memory.near, True)
        distance = _distance(arms, memory.trial, memory.near)
        if rank < best_rank or (rank == best_rank and distance < best_distance):
            best, best_rank, best_distance = branch, rank, distance
            memory.solution[:] = memory.q
    return best


@njit(error_model="numpy")
@no_type_check
def _continue(description: Record, memory: Record, chosen: int) -> int:
    """Look from `memory.near` itself where nothing was found close to it; the branch, -1 where still nothing was."""
    arms, off = description.arms, math.inf
    if chosen >= 0:
        memory.trial[:] = memory.solution
        turn_into_limits(arms, memory.trial)
        turn_near(arms, memory.trial, memory.near, True)
        off = math.sqrt(_distance(arms, memory.trial, memory.near))
    if off <= AWAY:
        return chosen
    memory.q[:] = memory.near
    if not search(description, memory, memory.pose, memory.q):
        return chosen
    memory.trial[:] = memory.q
    inside = turn_into_limits(arms, memory.trial)
    turn_near(arms, memory.trial, memory.near, True)
    if not inside or not math.sqrt(_distance(arms, memory.trial, memory.near)) < off:
        return chosen
    memory.solution[:] = memory.q
    lies = branch_of(description, memory, memory.q)
    memory.checked[:] = math.nan
    _solve_nominal(description, memory)
    return lies


@njit(error_model="numpy")
@no_type_check
def _solve_nominal(description: Record, memory: Record) -> None:
    """Write joint values of the nominal arm near `memory.q` into `memory.nominal`, NaN where there are none."""
    newton(description, memory, NOMINAL, memory.pose, memory.q, TOLERANCE)
    square = 0.0
    for i in range(6):
        square += memory.best[i] ** 2
    memory.nominal[:] = math.nan
    if square < ACCEPTED * ACCEPTED:
        memory.nominal[:] = memory.q


@njit(error_model="numpy")
@no_type_check
def _nearest(description: Record, memory: Record, free: bool) -> tuple[int, float]:
    """Of the branches that are left the nearest one and its squared distance; -1 where none is left."""
    arms, nearest, least = description.arms, -1, math.inf
    for branch in range(description.closed_form.branches):
        if math.isnan(memory.others[branch, 0]):
            continue
        if not free:
            return branch, 0.0
        memory.q[:] = memory.others[branch]
        turn_near(arms, memory.q, memory.near, True)
        distance = _distance(arms, memory.q, memory.near)
        if distance < least:
            nearest, least = branch, distance
    return nearest, least


@njit(error_model="numpy")
@no_type_check
def _distance(arms: Record, q: Array, near: Array) -> float:
    total = 0.0
    for j in range(arms.dof):
        total += (q[j] - near[j]) ** 2
    return total


@njit(error_model="numpy")
@no_type_check
def _solve_without_branches(description: Record, memory: Record, has_near: bool) -> int:
    """Numeric inverse from `near`, then from the starts whose poses are nearest; 0, or -1 if none leads there."""
    count = nearest_starts(description, memory, memory.pose)
    for attempt in range(-1 if has_near else 0, count):
        if attempt < 0:
            memory.q[:] = memory.near
        else:
            memory.q[:] = description.starts.q[memory.nearest[attempt]]
        if search(description, memory, memory.pose, memory.q):
            memory.solution[:] = memory.q
            memory.checked[:] = math.nan
            _solve_nominal(description, memory)
            return 0
    return -1


@njit(error_model="numpy")
@no_type_check
def _finish(
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
    found[place + 2] = share if arms.hybrid else math.nan
    turn_near(arms, memory.nominal, q, False)
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
    memory.q[:] = q
    inside = turn_into_limits(arms, q)
    if has_near:
        turn_near(arms, q, memory.near, True)
    turned = False
    for j in range(arms.dof):
        turned = turned or memory.q[j] != q[j]
    if not turned or not arms.hybrid or description.correction.periodic:
        return inside, True
    memory.q[:] = q
    if not search(description, memory, memory.pose, memory.q):
        return inside, False
    turn_near(arms, memory.q, q, False)
    q[:] = memory.q
    for j in range(arms.dof):
        inside = inside and arms.limits[j, 0] - _LIMIT <= q[j] <= arms.limits[j, 1] + _LIMIT
    return inside, True
