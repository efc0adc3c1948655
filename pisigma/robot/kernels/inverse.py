"""Corrected inverse kinematics of one pose, on plain numbers; see `model.inverse`."""

import math

from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.closed_form import all_branches, nearest_turn, wrap_into_limits
from pisigma.robot.kernels.damped_step import is_singular
from pisigma.robot.kernels.joint_correction import beyond_measured, move
from pisigma.robot.kernels.network import add_correction, choose_corrected, finish_corrected
from pisigma.robot.kernels.newton import search
from pisigma.robot.kernels.recovery import (
    branch_of,
    differ,
    distance_from,
    is_redundant,
    nearest_starts,
    recover,
    settle,
    solve_nominal,
    solve_redundant,
    within_reach,
)
from pisigma.robot.kernels.rotations import pose_error, wrap
from pisigma.robot.kernels.rows import Array, Record, copy, fill, kernel
from pisigma.robot.kernels.task_axes import level_pose, write_residuals
from pisigma.robot.kinematics import tolerances

_DISTINCT, _FAR = 0.05, 0.5
"""Difference of a joint value [rad or m] above which solutions are different; much larger for redundant arms."""


@kernel
def solve_pose(description: Record, memory: Record, has_near: bool, branch: int, out: Array) -> None:
    """Find commanded joint values for the pose in `memory.pose`.

    Args:
        description: the calibrated arm.
        memory: working memory, with the checked target T_base_tool and the reference joint values.
        has_near: whether there are reference joint values.
        branch: index of the requested branch, or -1.
        out: `(2 · dof + 5,)`, output: commanded and nominal joint values [rad or m], distance [m] and angle [rad]
            from the pose, measure of the domain, status and branch.
    """
    form, chosen = description.closed_form, -1
    wanted = form.order[0] if branch < 0 else branch
    fill(memory.nominal, math.nan)
    level = level_pose(description, memory)
    if description.network.used:
        _solve_by_network(description, memory, has_near, branch, wanted, out)
        return
    if not level or not within_reach(description, memory, memory.pose):
        pass
    elif is_redundant(description, memory):
        chosen = solve_redundant(description, memory, has_near, branch)
    elif form.kind == arrays.NO_CLOSED_FORM:
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
    reached, status = finish(description, memory, has_near, chosen >= 0, out)
    _write(description, memory, reached, status, wanted if chosen < 0 else chosen, out)


@kernel
def solve_every(description: Record, memory: Record, out: Array) -> None:
    """Write different solutions of the pose in `memory.pose` for an arm without a closed form; see `solve_pose`."""
    reachable = level_pose(description, memory) and within_reach(description, memory, memory.pose)
    count = _distinct_solutions(description, memory, out.shape[0]) if reachable else 0
    for row in range(out.shape[0]):
        fill(memory.nominal, math.nan)
        if row < count:
            copy(memory.candidates[row], memory.solution)
            copy(memory.solution, memory.q)
            solve_nominal(description, memory)
            fill(memory.checked, math.nan)
        reached, status = finish(description, memory, False, row < count, out[row])
        _write(description, memory, reached, status, 0, out[row])


@kernel
def _distinct_solutions(description: Record, memory: Record, most: int) -> int:
    """Store the distinct joint values that reach the pose in `memory.candidates`; return their number."""
    arms, count = description.arms, 0
    least = _FAR if is_redundant(description, memory) else _DISTINCT
    starts = nearest_starts(description, memory, memory.pose, tolerances.MORE_ATTEMPTS)
    for attempt in range(starts):
        if count == min(most, memory.rank.shape[0]):
            break
        copy(description.starts.q[memory.nearest[attempt]], memory.q)
        if not settle(description, memory, False, memory.q):
            continue
        wrap_into_limits(arms, memory.q)
        fresh = True
        for index in range(count):
            fresh = fresh and differ(arms, memory.q, memory.candidates[index]) > least
        if fresh:
            copy(memory.q, memory.candidates[count])
            count += 1
    return count


@kernel
def _solve_by_network(
    description: Record, memory: Record, has_near: bool, branch: int, wanted: int, out: Array
) -> None:
    """Solve the pose with a network that corrects the nominal joint values."""
    chosen, inside = choose_corrected(description, memory, has_near, branch, wanted)
    numeric = description.closed_form.kind == arrays.NO_CLOSED_FORM and within_reach(
        description, memory, memory.pose
    )
    if numeric and _solve_without_branches(description, memory, has_near):
        copy(memory.solution, memory.nominal)
        chosen, inside = 0, add_correction(description, memory, has_near)
    fill(out, math.nan)
    status = arrays.UNREACHABLE
    if chosen >= 0:
        status = finish_corrected(description, memory, chosen, inside, out)
    _write(description, memory, chosen >= 0, status, wanted if chosen < 0 else chosen, out)


@kernel
def _write(description: Record, memory: Record, reached: bool, status: int, branch: int, out: Array) -> None:
    """Write joint values (NaN if they do not reach the pose), status and branch."""
    dof = description.arms.dof
    for j in range(dof):
        out[j] = memory.solution[j] if reached else math.nan
        out[dof + j] = memory.nominal[j] if reached else math.nan
    out[2 * dof + 3], out[2 * dof + 4] = status, branch


@kernel
def _solve_in_order(description: Record, memory: Record, wanted: int) -> int:
    """Solve on the requested branch, or the first that reaches the pose inside the limits; return it, or -1.

    If all branches reach it outside the limits only, the first of them is returned. Joint values are in
    `memory.solution`.
    """
    arms, form, outside = description.arms, description.closed_form, -1
    first = form.order[0] if wanted < 0 else wanted
    all_branches(arms, form, memory.level, first, memory.rounding, memory.wanted, memory.branches)
    for place in range(form.branches if wanted < 0 else 1):
        if place == 1:
            all_branches(arms, form, memory.level, -1, memory.rounding, memory.wanted, memory.branches)
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


@kernel
def _follow(description: Record, memory: Record, branch: int) -> bool:
    """Solve from the nominal joint values of a branch, shifted to the turns of `memory.q`."""
    arms = description.arms
    copy(memory.branches[branch], memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return False
    for j in range(arms.dof):
        if arms.revolute[j]:
            memory.q[j] = memory.branches[branch, j] + wrap(memory.q[j] - memory.branches[branch, j])
    return True


@kernel
def _solve_nearest(description: Record, memory: Record) -> int:
    """Solve for joint values `memory.solution` near `memory.near`; return their branch, or -1.

    The nearest branch that reaches the pose inside the limits is preferred, otherwise the nearest other branch.
    """
    arms, form, others = description.arms, description.closed_form, memory.others
    all_branches(arms, form, memory.level, -1, memory.rounding, memory.wanted, memory.branches)
    for index in range(form.branches):
        copy(memory.branches[index], others[index])
    best, best_rank, best_distance = -1, 2, math.inf
    while True:
        branch, distance = _nearest(description, memory)
        if branch < 0 or (
            best_rank == 0 and math.sqrt(distance) - tolerances.MAX_CORRECTION > math.sqrt(best_distance)
        ):
            break
        others[branch, 0] = math.nan
        if not _follow(description, memory, branch):
            continue
        copy(memory.q, memory.trial)
        rank = 0 if wrap_into_limits(arms, memory.trial) else 1
        nearest_turn(arms, memory.trial, memory.near, True)
        distance = distance_from(arms, memory.trial, memory.near)
        if rank < best_rank or (rank == best_rank and distance < best_distance):
            best, best_rank, best_distance = branch, rank, distance
            copy(memory.q, memory.solution)
    return best


@kernel
def _continue(description: Record, memory: Record, chosen: int) -> int:
    """Iterate from `memory.near` itself if nothing was found close to it; return the branch, or -1."""
    arms, off = description.arms, math.inf
    if chosen >= 0:
        copy(memory.solution, memory.trial)
        wrap_into_limits(arms, memory.trial)
        nearest_turn(arms, memory.trial, memory.near, True)
        off = math.sqrt(distance_from(arms, memory.trial, memory.near))
    if off <= tolerances.FAR_AWAY:
        return chosen
    copy(memory.near, memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return chosen
    copy(memory.q, memory.trial)
    inside = wrap_into_limits(arms, memory.trial)
    nearest_turn(arms, memory.trial, memory.near, True)
    if not inside or not math.sqrt(distance_from(arms, memory.trial, memory.near)) < off:
        return chosen
    copy(memory.q, memory.solution)
    lies = branch_of(description, memory, memory.q)
    fill(memory.checked, math.nan)
    solve_nominal(description, memory)
    return lies


@kernel
def _nearest(description: Record, memory: Record) -> tuple[int, float]:
    """Return the nearest of the remaining branches and its squared distance; -1 if there is none."""
    arms, nearest, least = description.arms, -1, math.inf
    for branch in range(description.closed_form.branches):
        if math.isnan(memory.others[branch, 0]):
            continue
        copy(memory.others[branch], memory.q)
        nearest_turn(arms, memory.q, memory.near, True)
        distance = distance_from(arms, memory.q, memory.near)
        if distance < least:
            nearest, least = branch, distance
    return nearest, least


@kernel
def _solve_without_branches(description: Record, memory: Record, has_near: bool) -> bool:
    """Iterate from `near`, then from the starts with the nearest poses; return whether the pose is reached.

    The first solution inside the joint limits is used, else the first solution.
    """
    count, reached = nearest_starts(description, memory, memory.pose, tolerances.MORE_ATTEMPTS), False
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
        solve_nominal(description, memory)
    return reached


@kernel
def finish(
    description: Record, memory: Record, has_near: bool, reached: bool, out: Array
) -> tuple[bool, int]:
    """Select the turns, write residuals and domain measure; return whether the pose is reached, and the status."""
    arms, q, place = description.arms, memory.solution, 2 * description.arms.dof
    inside = False
    if reached:
        inside, reached = _choose_turns(description, memory, has_near)
    if not reached:
        out[place], out[place + 1], out[place + 2] = math.nan, math.nan, math.nan
        return False, arrays.UNREACHABLE
    fresh = memory.whole == 1
    for j in range(arms.dof):
        fresh = fresh and memory.checked[j] == q[j]
    if not fresh:
        move(description, memory, arrays.CORRECTED if arms.corrected else arrays.IDENTIFIED, q)
        pose_error(memory.pose, memory.T, memory.R, memory.error)
    write_residuals(arms, memory, memory.error, out)
    beyond = beyond_measured(description, q) if arms.corrected else math.nan
    out[place + 2] = 1 + beyond
    nearest_turn(arms, memory.nominal, q, False)
    if not inside:
        return True, arrays.OUTSIDE_LIMITS
    if is_singular(arms, arms.reach[arrays.IDENTIFIED], memory.J, tolerances.SINGULAR_TOLERANCE, memory):
        return True, arrays.SINGULAR
    return True, arrays.OUTSIDE_DOMAIN if beyond > tolerances.MEASURED_ROUNDING else arrays.REACHED


@kernel
def _choose_turns(description: Record, memory: Record, has_near: bool) -> tuple[bool, bool]:
    """Shift joints into the limits near the reference; return whether they are inside and reach the pose."""
    arms, q = description.arms, memory.solution
    copy(q, memory.q)
    inside = wrap_into_limits(arms, q)
    if has_near:
        nearest_turn(arms, q, memory.near, True)
    turned = False
    for j in range(arms.dof):
        turned = turned or memory.q[j] != q[j]
    if not turned or not arms.corrected or description.correction.periodic:
        return inside, True
    copy(q, memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return inside, False
    nearest_turn(arms, memory.q, q, False)
    copy(memory.q, q)
    slack = tolerances.LIMIT_TOLERANCE
    for j in range(arms.dof):
        inside = inside and arms.limits[j, 0] - slack <= q[j] <= arms.limits[j, 1] + slack
    return inside, True
