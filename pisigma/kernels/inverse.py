"""Corrected inverse kinematics of one pose, on plain numbers: what `correction.corrected_ik` does for batches."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import NO_CLOSED_FORM, NOMINAL
from pisigma.kernels.closed_form import all_branches, nearest_turn, wrap_into_limits
from pisigma.kernels.codes import UNREACHABLE
from pisigma.kernels.corrected import add_correction, choose_corrected, finish_corrected
from pisigma.kernels.finishing import finish
from pisigma.kernels.newton import ACCEPTED, TOLERANCE, newton, search
from pisigma.kernels.recovery import MORE_ATTEMPTS, branch_of, nearest_starts, recover, within_reach
from pisigma.kernels.rotations import wrap
from pisigma.kernels.rows import copy, fill

Array = Any
Record = Any

_MARGIN = 1.0
"""[rad or m] Corrections are smaller, so that branches that are farther off need not be corrected to be compared."""
AWAY = 0.1
"""[rad or m] A solution farther from where it was to be near to may not be the one that was meant."""


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
            from the pose, measure of the domain, status and branch.
    """
    form, chosen = description.closed_form, -1
    wanted = form.order[0] if branch < 0 else branch
    fill(memory.nominal, math.nan)
    if description.network.used:
        _solve_by_network(description, memory, has_near, branch, wanted, found)
        return
    if not within_reach(description, memory.pose):
        pass
    elif form.kind == NO_CLOSED_FORM:
        chosen = 0 if _solve_without_branches(description, memory, has_near) else -1
    else:
        free = has_near and branch < 0
        chosen = _solve_nearest(description, memory) if free else _solve_in_order(description, memory, branch)
        if chosen >= 0:
            copy(memory.branches[chosen], memory.nominal)
        else:
            chosen = recover(description, memory, wanted, branch < 0)
        if free:
            chosen = _continue(description, memory, chosen)
    reached, status = finish(description, memory, has_near, chosen >= 0, found)
    _write(description, memory, reached, status, wanted if chosen < 0 else chosen, found)


@njit(error_model="numpy")
@no_type_check
def _solve_by_network(
    description: Record, memory: Record, has_near: bool, branch: int, wanted: int, found: Array
) -> None:
    """The same where a network corrects the nominal joint values."""
    chosen, inside = choose_corrected(description, memory, has_near, branch, wanted)
    numeric = description.closed_form.kind == NO_CLOSED_FORM and within_reach(description, memory.pose)
    if numeric and _solve_without_branches(description, memory, has_near):
        copy(memory.solution, memory.nominal)
        chosen, inside = 0, add_correction(description, memory, has_near)
    fill(found, math.nan)
    status = UNREACHABLE
    if chosen >= 0:
        status = finish_corrected(description, memory, chosen, inside, found)
    _write(description, memory, chosen >= 0, status, wanted if chosen < 0 else chosen, found)


@njit(error_model="numpy")
@no_type_check
def _write(
    description: Record, memory: Record, reached: bool, status: int, branch: int, found: Array
) -> None:
    """Write the joint values in memory, NaN where they do not reach the pose, the status and the branch."""
    dof = description.arms.dof
    for j in range(dof):
        found[j] = memory.solution[j] if reached else math.nan
        found[dof + j] = memory.nominal[j] if reached else math.nan
    found[2 * dof + 3], found[2 * dof + 4] = status, branch


@njit(error_model="numpy")
@no_type_check
def _solve_in_order(description: Record, memory: Record, wanted: int) -> int:
    """Solve on the wanted branch, or on the first that reaches the pose inside the limits; -1 if none reaches it.

    Where one does that only outside its limits, it is the first of these. Joint values go to `memory.solution`.
    """
    arms, form, outside = description.arms, description.closed_form, -1
    first = form.order[0] if wanted < 0 else wanted
    all_branches(arms, form, memory.pose, first, memory.wanted, memory.branches)
    for place in range(form.branches if wanted < 0 else 1):
        if place == 1:
            all_branches(arms, form, memory.pose, -1, memory.wanted, memory.branches)
        branch = form.order[place] if wanted < 0 else wanted
        if math.isnan(memory.branches[branch, 0]) or not _follow(description, memory, branch):
            continue
        copy(memory.q, memory.trial)
        if wanted >= 0 or wrap_into_limits(arms, memory.trial):
            copy(memory.q, memory.solution)
            return branch
        if outside < 0:
            outside = branch
            copy(memory.q, memory.kept)
    if outside >= 0:
        copy(memory.kept, memory.solution)
    return outside


@njit(error_model="numpy")
@no_type_check
def _follow(description: Record, memory: Record, branch: int) -> bool:
    """Solve from the nominal joint values of a branch on, for joint values `memory.q` on their turns."""
    arms = description.arms
    copy(memory.branches[branch], memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return False
    for j in range(arms.dof):
        if arms.revolute[j]:
            memory.q[j] = memory.branches[branch, j] + wrap(memory.q[j] - memory.branches[branch, j])
    return True


@njit(error_model="numpy")
@no_type_check
def _solve_nearest(description: Record, memory: Record) -> int:
    """Solve for joint values `memory.solution` near to `memory.near`; give their branch, or -1.

    The nearest of the branches that reach the pose inside the limits is best, else of the others.
    """
    arms, form, others = description.arms, description.closed_form, memory.others
    all_branches(arms, form, memory.pose, -1, memory.wanted, memory.branches)
    for index in range(form.branches):
        copy(memory.branches[index], others[index])
    best, best_rank, best_distance = -1, 2, math.inf
    while True:
        branch, distance = _nearest(description, memory)
        if branch < 0 or (best_rank == 0 and math.sqrt(distance) - _MARGIN > math.sqrt(best_distance)):
            break
        others[branch, 0] = math.nan
        if not _follow(description, memory, branch):
            continue
        copy(memory.q, memory.trial)
        rank = 0 if wrap_into_limits(arms, memory.trial) else 1
        nearest_turn(arms, memory.trial, memory.near, True)
        distance = _distance(arms, memory.trial, memory.near)
        if rank < best_rank or (rank == best_rank and distance < best_distance):
            best, best_rank, best_distance = branch, rank, distance
            copy(memory.q, memory.solution)
    return best


@njit(error_model="numpy")
@no_type_check
def _continue(description: Record, memory: Record, chosen: int) -> int:
    """Look from `memory.near` itself where nothing was found close to it; the branch, -1 where still nothing was."""
    arms, off = description.arms, math.inf
    if chosen >= 0:
        copy(memory.solution, memory.trial)
        wrap_into_limits(arms, memory.trial)
        nearest_turn(arms, memory.trial, memory.near, True)
        off = math.sqrt(_distance(arms, memory.trial, memory.near))
    if off <= AWAY:
        return chosen
    copy(memory.near, memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return chosen
    copy(memory.q, memory.trial)
    inside = wrap_into_limits(arms, memory.trial)
    nearest_turn(arms, memory.trial, memory.near, True)
    if not inside or not math.sqrt(_distance(arms, memory.trial, memory.near)) < off:
        return chosen
    copy(memory.q, memory.solution)
    lies = branch_of(description, memory, memory.q)
    fill(memory.checked, math.nan)
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
    fill(memory.nominal, math.nan)
    if square < ACCEPTED * ACCEPTED:
        copy(memory.q, memory.nominal)


@njit(error_model="numpy")
@no_type_check
def _nearest(description: Record, memory: Record) -> tuple[int, float]:
    """Of the branches that are left the nearest one and its squared distance; -1 where none is left."""
    arms, nearest, least = description.arms, -1, math.inf
    for branch in range(description.closed_form.branches):
        if math.isnan(memory.others[branch, 0]):
            continue
        copy(memory.others[branch], memory.q)
        nearest_turn(arms, memory.q, memory.near, True)
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
def _solve_without_branches(description: Record, memory: Record, has_near: bool) -> bool:
    """Numeric inverse from `near`, then from the starts whose poses are nearest; whether one leads there.

    The first that leads there inside the joint limits is taken, else the first that leads there.
    """
    count, reached = nearest_starts(description, memory, memory.pose, MORE_ATTEMPTS), False
    for attempt in range(-1 if has_near else 0, count):
        if attempt < 0:
            copy(memory.near, memory.q)
        else:
            copy(description.starts.q[memory.nearest[attempt]], memory.q)
        if not search(description, memory, memory.pose, memory.q):
            continue
        copy(memory.q, memory.trial)
        inside = wrap_into_limits(description.arms, memory.trial)
        if inside or not reached:
            copy(memory.q, memory.kept)
        reached = True
        if inside:
            break
    if reached:
        copy(memory.kept, memory.solution)
        fill(memory.checked, math.nan)
        _solve_nominal(description, memory)
    return reached
