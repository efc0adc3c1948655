"""Poses that the calibrated arm reaches and the nominal one does not, on plain numbers."""

import math

from pisigma.kernels.arrays import IDENTIFIED, NEAREST, NOMINAL
from pisigma.kernels.chain import walk
from pisigma.kernels.closed_form import all_branches
from pisigma.kernels.damped_step import scaled_square
from pisigma.kernels.motion import move
from pisigma.kernels.newton import search
from pisigma.kernels.rotations import pose_error, wrap
from pisigma.kernels.rows import Array, Record, copy, fill, kernel
from pisigma.kinematics.tolerances import ATTEMPTS, BESIDE, REACH_ROUNDING


@kernel
def within_reach(description: Record, T: Array) -> bool:
    """Whether a pose is not farther away than the robot is long, whatever its joints do."""
    base, reach = description.arms.ends[IDENTIFIED, 0], description.arms.reach[IDENTIFIED]
    x, y, z = T[0, 3] - base[0, 3], T[1, 3] - base[1, 3], T[2, 3] - base[2, 3]
    return math.sqrt(x * x + y * y + z * z) <= reach * (1 + REACH_ROUNDING)


@kernel
def nearest_starts(description: Record, memory: Record, T: Array, most: int) -> int:
    """Write the indices of the starts whose poses are nearest into `memory.nearest`, nearest first; their number."""
    starts, near = description.starts, memory.nearest
    count = min(most, starts.count)
    best = memory.distance  # squared
    fill(best, math.inf)
    for s in range(starts.count):
        point, distance = starts.points[s], 0.0
        for i in range(3):
            distance += (T[i, 3] - point[i]) ** 2
            for k in range(3):
                distance += (starts.lever * T[i, k] - point[3 + 3 * i + k]) ** 2
        if distance >= best[count - 1]:
            continue
        place = count - 1
        while place > 0 and best[place - 1] > distance:
            best[place], near[place] = best[place - 1], near[place - 1]
            place -= 1
        best[place], near[place] = distance, s
    return count


@kernel
def recover(description: Record, memory: Record, branch: int, any_branch: bool) -> int:
    """Look for joint values from other starts; see `inverse.identified_arm.IdentifiedArm.recover`.

    Args:
        description: the calibrated arm.
        memory: to work in, with the pose; the joint values found are written into `memory.solution`.
        branch: index of the branch wanted.
        any_branch: whether another will do.

    Returns:
        Index of the branch on which they lie, -1 where nothing was out.
    """
    form, starts, beside, plausible = description.closed_form, description.starts, memory.others, False
    all_branches(description.arms, form, memory.pose, NEAREST, memory.rounding, memory.wanted, beside)
    for index in range(form.branches):
        if _is_near(description, memory, beside[index]):
            plausible = True
        else:
            beside[index, 0] = math.nan
    if not plausible:
        return -1
    count = nearest_starts(description, memory, memory.pose, ATTEMPTS) if starts.count > 0 else 0
    for attempt in range(1 + form.branches + count if any_branch else 1):
        place = branch if attempt == 0 else attempt - 1
        if attempt > form.branches:
            copy(starts.q[memory.nearest[attempt - 1 - form.branches]], memory.q)
        elif math.isnan(beside[place, 0]) or (attempt > 0 and place == branch):
            continue
        else:
            copy(beside[place], memory.q)
        if search(description, memory, memory.pose, memory.q):
            copy(memory.q, memory.solution)
            lies = branch_of(description, memory, memory.q)
            fill(memory.checked, math.nan)
            return lies if any_branch or lies == branch else -1
    return -1


@kernel
def _is_near(description: Record, memory: Record, q: Array) -> bool:
    """Whether joint values of a nominal branch bring the identified arm near the pose; NaN do not."""
    move(description, memory, IDENTIFIED, q)
    pose_error(memory.pose, memory.T, memory.R, memory.error)
    return scaled_square(description.arms.reach[IDENTIFIED], memory.error) <= BESIDE * BESIDE


@kernel
def branch_of(description: Record, memory: Record, q: Array) -> int:
    """Index of the nominal arm's branch that is nearest to joint values."""
    walk(description.arms, NOMINAL, q, memory.axes, memory.T)
    every = memory.others
    all_branches(
        description.arms, description.closed_form, memory.T, -1, memory.rounding, memory.wanted, every
    )
    nearest, least = 0, math.inf
    for branch in range(description.closed_form.branches):
        total = 0.0
        for j in range(description.arms.dof):
            off = every[branch, j] - q[j]
            total += (wrap(off) if description.arms.revolute[j] else off) ** 2
        if total < least:
            nearest, least = branch, total
    return nearest
