"""Inverse kinematics of a nominal arm whose joint values a network corrects, on plain numbers."""

import math
from typing import Any, no_type_check

from numba import njit

from pisigma.kernels.arrays import NO_CLOSED_FORM, NOMINAL
from pisigma.kernels.chain import walk
from pisigma.kernels.closed_form import all_branches, nearest_turn, wrap_into_limits
from pisigma.kernels.codes import (
    OUTSIDE_DOMAIN,
    OUTSIDE_LIMITS,
    REACHED,
    SINGULAR,
    SINGULAR_TOLERANCE,
)
from pisigma.kernels.damped_step import is_singular
from pisigma.kernels.motion import move
from pisigma.kernels.network import ACCEPTED, ROUNDS, SETTLED, domain_measure, network_correction
from pisigma.kernels.rotations import pose_error
from pisigma.kernels.rows import copy

Array = Any
Record = Any


@njit(error_model="numpy")
@no_type_check
def choose_corrected(
    description: Record, memory: Record, has_near: bool, branch: int, wanted: int
) -> tuple[int, bool]:
    """Put the solution of the branch to take into memory, by the rules of `solve_pose`.

    Args:
        description: the arm and its network.
        memory: to work in.
        has_near: whether there are joint values to be near to.
        branch: index of the branch wanted, or -1.
        wanted: index of the first branch to try.

    Returns:
        Index of the branch, -1 where none reaches the pose, and whether it does so inside the limits.
    """
    arms, form = description.arms, description.closed_form
    if form.kind == NO_CLOSED_FORM:
        return -1, False
    only = -1 if branch < 0 else branch
    all_branches(arms, form, memory.pose, only, memory.wanted, memory.branches)
    best, best_rank, best_distance = -1, 2, math.inf
    for place in range(form.branches if branch < 0 else 1):
        candidate = place if has_near else form.order[place]
        if branch >= 0:
            candidate = wanted
        if math.isnan(memory.branches[candidate, 0]):
            continue
        copy(memory.branches[candidate], memory.nominal)
        rank, distance = 0 if add_correction(description, memory, has_near) else 1, 0.0
        if branch >= 0 or (rank == 0 and not has_near):
            return candidate, rank == 0
        for j in range(arms.dof if has_near else 0):
            distance += (memory.solution[j] - memory.near[j]) ** 2
        if rank < best_rank or (rank == best_rank and distance < best_distance):
            best, best_rank, best_distance = candidate, rank, distance
    inside = False
    if best >= 0:
        copy(memory.branches[best], memory.nominal)
        inside = add_correction(description, memory, has_near)
    return best, inside


@njit(error_model="numpy")
@no_type_check
def add_correction(description: Record, memory: Record, has_near: bool) -> bool:
    """Correct `memory.nominal` to `memory.solution`, both on the turns to command; whether inside the limits."""
    arms, q = description.arms, memory.q
    copy(memory.nominal, q)
    nearest_turn(arms, q, description.network.centre, False)  # as the training rows were turned
    network_correction(description, memory, memory.pose, q)
    for j in range(arms.dof):
        q[j] = memory.nominal[j] + memory.delta[j]
    copy(q, memory.solution)
    inside = wrap_into_limits(arms, memory.solution)
    if has_near:
        nearest_turn(arms, memory.solution, memory.near, True)
    for j in range(arms.dof):
        memory.nominal[j] += memory.solution[j] - q[j]
    return inside


@njit(error_model="numpy")
@no_type_check
def finish_corrected(description: Record, memory: Record, branch: int, inside: bool, found: Array) -> int:
    """Write what is left of the error and the measure of the domain; give the status."""
    arms, form, place = description.arms, description.closed_form, 2 * description.arms.dof
    measure = domain_measure(description, memory)
    found[place + 2] = measure
    _settle(description, memory, found)
    if not inside:
        return OUTSIDE_LIMITS
    move(description, memory, NOMINAL, memory.nominal)
    if is_singular(arms, arms.reach[NOMINAL], memory.J, SINGULAR_TOLERANCE, memory):
        return SINGULAR
    trained = False
    for index in range(form.trained):
        trained = trained or form.order[index] == branch
    covered = description.network.samples == 0 or (measure <= 1 and trained)
    return REACHED if covered else OUTSIDE_DOMAIN


@njit(error_model="numpy")
@no_type_check
def _settle(description: Record, memory: Record, found: Array) -> None:
    """Write how far the pose is missed whose corrected joint values are the solution; NaN where there is none.

    See `correction.calibrated_model.CalibratedModel.forward`; iteration begins at the nominal joint values found.
    """
    arms, q, place, moved = description.arms, memory.trial, 2 * description.arms.dof, 0.0
    copy(memory.nominal, q)
    for _ in range(ROUNDS):
        walk(arms, NOMINAL, q, memory.axes, memory.T)
        network_correction(description, memory, memory.T, q)
        moved = 0.0
        for j in range(arms.dof):
            following = memory.solution[j] - memory.delta[j]
            moved = max(moved, abs(following - q[j]))
            q[j] = following
        if moved <= SETTLED:
            break
    found[place], found[place + 1] = math.nan, math.nan
    if not moved <= ACCEPTED:
        return
    walk(arms, NOMINAL, q, memory.axes, memory.T)
    pose_error(memory.pose, memory.T, memory.R, memory.error)
    e = memory.error
    found[place] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    found[place + 1] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
