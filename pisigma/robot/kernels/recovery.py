"""Search from several starts for poses beyond the nominal arm's reach and for redundant arms, on plain numbers."""

import math

from pisigma.robot.kernels.arrays import CORRECTED, IDENTIFIED, NEAREST, NO_CLOSED_FORM, NOMINAL
from pisigma.robot.kernels.chain import walk
from pisigma.robot.kernels.closed_form import all_branches, nearest_turn, wrap_into_limits
from pisigma.robot.kernels.damped_step import damped_step, scaled_square, singularity_measure
from pisigma.robot.kernels.joint_correction import move
from pisigma.robot.kernels.newton import newton, search, within
from pisigma.robot.kernels.rotations import wrap
from pisigma.robot.kernels.rows import Array, Record, copy, fill, kernel
from pisigma.robot.kernels.task_axes import free_orientations, is_free, miss, orient, use_elbow
from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.tolerances import ATTEMPTS, BRANCH_MISS, REACH_ROUNDING

_TURN = 0.2
"""Largest step of the elbow angle [rad]."""
_AROUND, _ASIDE = 8, 0.2
"""Number of starts that are tried for one branch, and offset of the joints of all but the first [rad]."""
_APART = 1e-4
"""Difference of a joint [rad or m] above which two solutions near a singular pose are different."""
_OUTSIDE = 1e6
"""Penalty in the merit of joint values outside their limits."""


@kernel
def within_reach(description: Record, memory: Record, T: Array) -> bool:
    """Return whether a pose is within the reach of the robot, if its position is part of the task."""
    if is_free(memory.tolerance[0]) or is_free(memory.tolerance[1]) or is_free(memory.tolerance[2]):
        return True
    base, reach = description.arms.ends[IDENTIFIED, 0], description.arms.reach[IDENTIFIED]
    x, y, z = T[0, 3] - base[0, 3], T[1, 3] - base[1, 3], T[2, 3] - base[2, 3]
    return math.sqrt(x * x + y * y + z * z) <= reach * (1 + REACH_ROUNDING)


@kernel
def nearest_starts(description: Record, memory: Record, T: Array, most: int) -> int:
    """Write the indices of the starts with the nearest poses into `memory.nearest`; return their number.

    If the orientation is partly free, the direction of the tool's rotation axis is compared.
    """
    starts, near = description.starts, memory.nearest
    pivot, turned = memory.pivot if memory.rows > 3 else -1, memory.whole == 1
    count = min(most, starts.count)
    best = memory.distance  # compared with squared distances
    fill(best, math.inf)
    for s in range(starts.count):
        point, distance = starts.points[s], 0.0
        for i in range(3):
            distance += (T[i, 3] - point[i]) ** 2
            for k in range(3):
                if turned or k == pivot:
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
    """Search for joint values from the values of branches nearest to the pose, like `model.inverse.numeric_ik`.

    Args:
        description: the calibrated arm.
        memory: working memory with the pose; joint values are written into `memory.solution`.
        branch: index of the requested branch.
        any_branch: whether another branch is accepted.

    Returns:
        Index of the branch of the joint values, -1 if nothing was found.
    """
    form, starts, branches, plausible = description.closed_form, description.starts, memory.others, False
    all_branches(description.arms, form, memory.level, NEAREST, memory.rounding, memory.wanted, branches)
    for index in range(form.branches):
        if _is_near(description, memory, branches[index]):
            plausible = True
        else:
            branches[index, 0] = math.nan
    if not plausible:
        return -1
    if not any_branch:
        return branch if _recover_branch(description, memory, branch) else -1
    count = nearest_starts(description, memory, memory.pose, ATTEMPTS) if starts.count > 0 else 0
    for attempt in range(1 + form.branches + count):
        place = branch if attempt == 0 else attempt - 1
        if attempt > form.branches:
            copy(starts.q[memory.nearest[attempt - 1 - form.branches]], memory.q)
        elif math.isnan(branches[place, 0]) or (attempt > 0 and place == branch):
            continue
        else:
            copy(branches[place], memory.q)
        if search(description, memory, memory.pose, memory.q):
            copy(memory.q, memory.solution)
            lies = branch_of(description, memory, memory.q)
            fill(memory.checked, math.nan)
            return lies
    return -1


@kernel
def _recover_branch(description: Record, memory: Record, branch: int) -> bool:
    """Search for joint values on one branch from the nearest values of the nominal arm in `memory.others`.

    Near singular poses two branches may lead to the same solution with the other one close to it, or two solutions
    may be nearest to one nominal branch; the solution that this branch does not lead to belongs to the other.
    """
    if math.isnan(memory.others[branch, 0]):
        return False
    copy(memory.others[branch], memory.chosen)
    for attempt in range(_AROUND):
        for j in range(description.arms.dof):
            side = 0.0 if attempt == 0 else -1.0 if 7 * attempt * (j + 3) % 8 < 4 else 1.0
            memory.q[j] = memory.chosen[j] + side * (_ASIDE if description.arms.revolute[j] else 0.0)
        if not search(description, memory, memory.pose, memory.q):
            continue
        copy(memory.q, memory.solution)
        lies = branch_of(description, memory, memory.q)
        another = lies == branch or _is_another(description, memory, lies)
        fill(memory.checked, math.nan)
        if another:
            return True
    return False


@kernel
def _is_another(description: Record, memory: Record, lies: int) -> bool:
    """Return whether `memory.solution` differs from the solution to which a nominal branch leads."""
    arms, form = description.arms, description.closed_form
    all_branches(arms, form, memory.level, NEAREST, memory.rounding, memory.wanted, memory.others)
    copy(memory.others[lies], memory.q)
    if not search(description, memory, memory.pose, memory.q):
        return False
    return differ(arms, memory.q, memory.solution) > _APART


@kernel
def differ(arms: Record, q: Array, other: Array) -> float:
    """Return the largest wrapped difference of a joint [rad or m]."""
    far = 0.0
    for j in range(arms.dof):
        off = q[j] - other[j]
        far = max(far, abs(wrap(off) if arms.revolute[j] else off))
    return far


@kernel
def _is_near(description: Record, memory: Record, q: Array) -> bool:
    """Return whether joint values of a nominal branch move the identified arm near the pose; False for NaN."""
    move(description, memory, IDENTIFIED, q)
    miss(description.arms, memory, memory.pose, memory.error)
    return scaled_square(description.arms.reach[IDENTIFIED], memory.error) <= BRANCH_MISS * BRANCH_MISS


@kernel
def branch_of(description: Record, memory: Record, q: Array) -> int:
    """Return the index of the nominal arm's branch nearest to joint values."""
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


@kernel
def solve_nominal(description: Record, memory: Record) -> None:
    """Write joint values of the nominal arm near `memory.q` into `memory.nominal`, NaN if there are none."""
    newton(description, memory, NOMINAL, memory.pose, memory.q, tolerances.TOLERANCE)
    fill(memory.nominal, math.nan)
    if within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED):
        copy(memory.q, memory.nominal)


@kernel
def distance_from(arms: Record, q: Array, near: Array) -> float:
    """Return the squared distance of joint values, with radians and metres weighted equally."""
    total = 0.0
    for j in range(arms.dof):
        total += (q[j] - near[j]) ** 2
    return total


@kernel
def is_redundant(description: Record, memory: Record) -> bool:
    """Return whether the arm has more joints than axes in use, or an elbow angle is requested."""
    return memory.rows < description.arms.dof or not math.isnan(memory.elbow)


@kernel
def solve_redundant(description: Record, memory: Record, has_near: bool, branch: int) -> int:
    """Solve a redundant arm near `memory.near`, else far from limits and singularities; return its branch, or -1.

    Args:
        description: the calibrated arm.
        memory: working memory with the pose; joint values are written into `memory.solution`.
        has_near: whether there are reference joint values.
        branch: index of the requested branch, or -1.
    """
    closed = description.closed_form.kind != NO_CLOSED_FORM
    candidates = _candidates(description, memory, has_near, branch) if closed else 0
    starts = nearest_starts(description, memory, memory.pose, tolerances.MORE_ATTEMPTS)
    best, count = -math.inf, 0
    for attempt in range(-1 if has_near else 0, candidates + starts):
        if attempt < 0:
            copy(memory.near, memory.q)
        elif attempt < candidates:
            copy(memory.candidates[attempt], memory.q)
        else:
            copy(description.starts.q[memory.nearest[attempt - candidates]], memory.q)
        if not settle(description, memory, has_near, memory.q):
            continue
        copy(memory.q, memory.trial)
        worth, inside = _worth(description, memory, has_near)
        if worth > best and (branch < 0 or not closed or branch_of(description, memory, memory.q) == branch):
            best = worth
            copy(memory.q, memory.chosen)
        count += 1 if inside else 0
        if count > 0 and (attempt < 0 or attempt >= ATTEMPTS - 1):
            break
    if best == -math.inf:
        return -1
    copy(memory.chosen, memory.q)
    lies = branch_of(description, memory, memory.q) if closed else 0
    copy(memory.chosen, memory.solution)
    fill(memory.checked, math.nan)
    solve_nominal(description, memory)
    return lies


@kernel
def _worth(description: Record, memory: Record, has_near: bool) -> tuple[float, bool]:
    """Shift `memory.trial` to the turns to command; return its merit, and whether it is within the limits."""
    arms, q = description.arms, memory.trial
    inside = wrap_into_limits(arms, q)
    if has_near:
        nearest_turn(arms, q, memory.near, True)
        worth = -math.sqrt(distance_from(arms, q, memory.near))
    else:
        move(description, memory, CORRECTED if arms.corrected else IDENTIFIED, q)
        miss(arms, memory, memory.pose, memory.error)
        fill(memory.checked, math.nan)
        worth = singularity_measure(arms, arms.reach[IDENTIFIED], memory.J, memory) * _margin(arms, q)
    return worth if inside else worth - _OUTSIDE, inside


@kernel
def _margin(arms: Record, q: Array) -> float:
    """Return the smallest distance of a joint from its limits divided by half its travel, at most 1."""
    least = 1.0
    for j in range(arms.dof):
        half = max((arms.limits[j, 1] - arms.limits[j, 0]) / 2, 1e-9)
        if half == math.inf:
            continue
        least = min(least, (q[j] - arms.limits[j, 0]) / half, (arms.limits[j, 1] - q[j]) / half)
    return least


@kernel
def settle(description: Record, memory: Record, has_near: bool, q: Array) -> bool:
    """Move q to the pose, the elbow angle and, for redundant arms, preferred values; return whether it succeeds.

    Preferred values are `memory.near` or the middle of the travel, with distances scaled by half the travel. Without
    `memory.near`, a joint without limits prefers its present value, with half a turn as its scale.
    """
    arms = description.arms
    if not search(description, memory, memory.pose, q):
        return False
    if not math.isnan(memory.elbow) and not _turn_elbow(description, memory, q):
        return False
    if memory.rows < arms.dof:
        wrap_into_limits(arms, q)
        copy(q, memory.preferred)
        for j in range(arms.dof):
            half = max((arms.limits[j, 1] - arms.limits[j, 0]) / 2, 1e-9)
            memory.kept[j] = memory.scale[j]
            memory.scale[j] = 1.0 if has_near else math.pi if half == math.inf else half
            if half < math.inf:
                memory.preferred[j] = (arms.limits[j, 0] + arms.limits[j, 1]) / 2
        if has_near:
            nearest_turn(arms, q, memory.near, True)
            copy(memory.near, memory.preferred)
        copy(q, memory.first)
        if not _approach_preferred(description, memory, q):
            copy(memory.first, q)
        copy(memory.kept, memory.scale)
    if not math.isnan(memory.elbow):
        use_elbow(memory, False)
    fill(memory.checked, math.nan)
    return True


@kernel
def _approach_preferred(description: Record, memory: Record, q: Array) -> bool:
    """Move joints to preferred values; see `kinematics.numeric.approach_preferred`; return whether the pose is kept."""
    arms, arm = description.arms, CORRECTED if description.arms.corrected else IDENTIFIED
    reach, share, before = arms.reach[IDENTIFIED], 1.0, math.inf
    for _ in range(tolerances.MAX_STEPS):
        move(description, memory, arm, q)
        miss(arms, memory, memory.pose, memory.error)
        for j in range(arms.dof):
            pull = share * (memory.preferred[j] - q[j]) if memory.scale[j] > 0 else 0.0
            memory.trial[j] = pull
            for i in range(memory.height):
                memory.error[i] -= memory.J[i, j] * pull
        if not damped_step(arms, reach, memory.J, memory.error, 0.0, memory):
            return False
        moved = 0.0
        for j in range(arms.dof):
            memory.trial[j] += memory.step[j]
            moved = max(moved, abs(memory.trial[j]))
        if moved > 0.7 * before:
            share *= 0.6
        before = moved
        for j in range(arms.dof):
            q[j] += memory.trial[j] * min(1.0, tolerances.MAX_STEP / moved)
            if not arms.limits[j, 0] <= q[j] <= arms.limits[j, 1]:
                q[j] = min(max(q[j], arms.limits[j, 0]), arms.limits[j, 1])
                memory.scale[j] = 0.0
        if moved < tolerances.STEP_TOLERANCE:
            break
    newton(description, memory, arm, memory.pose, q, tolerances.HYBRID_TOLERANCE)
    return within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED)


@kernel
def _turn_elbow(description: Record, memory: Record, q: Array) -> bool:
    """Rotate the elbow to `memory.elbow`, in the shorter sense first; return whether it reaches that angle."""
    arms, arm = description.arms, CORRECTED if description.arms.corrected else IDENTIFIED
    use_elbow(memory, True)
    memory.elbow_now = memory.elbow
    copy(q, memory.first)
    move(description, memory, arm, q)
    miss(arms, memory, memory.pose, memory.error)
    short = memory.error[6]
    for way in range(2):
        off = short if way == 0 else short - math.copysign(2 * math.pi, short)
        steps, reached = math.ceil(abs(off) / _TURN) + 1, True
        copy(memory.first, q)
        for step in range(1, steps + 1):
            memory.elbow_now = wrap(memory.elbow - off * (steps - step) / steps)
            newton(description, memory, arm, memory.pose, q, tolerances.HYBRID_TOLERANCE)
            if not within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED):
                reached = False
                break
        if reached:
            return True
    use_elbow(memory, False)
    return False


@kernel
def _candidates(description: Record, memory: Record, has_near: bool, branch: int) -> int:
    """Store joint values of the nominal arm for free orientations, the best first; return their number."""
    arms, form, count = description.arms, description.closed_form, 0
    for index in range(free_orientations(memory)):
        orient(memory, index)
        all_branches(arms, form, memory.level, max(branch, -1), memory.rounding, memory.wanted, memory.others)
        for place in range(form.branches):
            if not math.isnan(memory.others[place, 0]):
                count = _keep_candidate(description, memory, has_near, memory.others[place], count)
    return count


@kernel
def _keep_candidate(description: Record, memory: Record, has_near: bool, q: Array, count: int) -> int:
    """Insert joint values into the candidates by rank, if it is high enough; return the number of candidates."""
    arms, rank = description.arms, 0.0
    inside = wrap_into_limits(arms, q)
    if has_near:
        nearest_turn(arms, q, memory.near, True)
        rank = distance_from(arms, q, memory.near)
    else:
        rank = -_margin(arms, q)
    if not inside:
        rank += _OUTSIDE
    most = memory.rank.shape[0]
    if count == most and rank >= memory.rank[most - 1]:
        return count
    place = min(count, most - 1)
    while place > 0 and memory.rank[place - 1] > rank:
        memory.rank[place] = memory.rank[place - 1]
        copy(memory.candidates[place - 1], memory.candidates[place])
        place -= 1
    memory.rank[place] = rank
    copy(q, memory.candidates[place])
    return min(count + 1, most)
