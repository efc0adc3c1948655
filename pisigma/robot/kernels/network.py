"""Network correction of the nominal joint values of a pose, and distance of the pose from training rows.

The formulas are those of `network.correction_network` and `model.domain`, on plain numbers.
"""

import math

from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.chain import walk
from pisigma.robot.kernels.closed_form import all_branches, nearest_turn, wrap_into_limits
from pisigma.robot.kernels.damped_step import is_singular
from pisigma.robot.kernels.joint_correction import move
from pisigma.robot.kernels.rotations import pose_error
from pisigma.robot.kernels.rows import Array, Record, copy, kernel
from pisigma.robot.kernels.task_axes import miss, write_residuals
from pisigma.robot.kinematics import tolerances


@kernel
def write_network_correction(
    description: Record, memory: Record, T_base_tool: Array, q_nominal: Array
) -> None:
    """Write the correction of nominal joint values into `memory.delta` and scaled inputs into `memory.seen`.

    Args:
        description: the arm and its network.
        memory: working memory.
        T_base_tool: pose of the tool `(3 or 4, 4)`.
        q_nominal: nominal joint values [rad or m].
    """
    net, x = description.network, memory.seen
    for i in range(net.inputs):
        x[i] = (_input(description, memory, T_base_tool, q_nominal, i) - net.offset[i]) / net.scale[i]
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


@kernel
def _input(description: Record, memory: Record, T: Array, q: Array, index: int) -> float:
    """Return one unscaled input; see `network.inputs.Inputs`."""
    net = description.network
    source = net.source[index]
    if source < 3:
        return T[source, 3]
    if source < arrays.ANGLE:
        group = 0
        while index >= net.first[group + 1]:
            group += 1
        _roll_pitch_yaw(net.reference[group], T, memory.R, memory.angles)
        return memory.angles[source - 3]
    angle = 0.0
    for j in range(description.arms.dof):
        angle += net.factors[index, j] * q[j]
    if source == arrays.ANGLE:
        return angle
    return math.sin(angle) if source == arrays.SINE else math.cos(angle)


@kernel
def _roll_pitch_yaw(reference: Array, T: Array, R: Array, angles: Array) -> None:
    """Write the angles of a rotation relative to a reference; see `se3.zyx_from_rotation`."""
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


@kernel
def domain_measure(description: Record, memory: Record) -> float:
    """Return the distance of `memory.seen` from the nearest training row over the radius; NaN without a domain.

    The coarse coordinates alone exclude most training rows.
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


@kernel
def choose_corrected(
    description: Record, memory: Record, has_near: bool, branch: int, wanted: int
) -> tuple[int, bool]:
    """Write the solution of the selected branch into memory, by the rules of `solve_pose`.

    Args:
        description: the arm and its network.
        memory: working memory.
        has_near: whether there are reference joint values.
        branch: index of the requested branch, or -1.
        wanted: index of the first branch to try.

    Returns:
        Index of the branch, -1 if none reaches the pose, and whether it is inside the limits.
    """
    arms, form = description.arms, description.closed_form
    if form.kind == arrays.NO_CLOSED_FORM:
        return -1, False
    only = -1 if branch < 0 else branch
    all_branches(arms, form, memory.level, only, memory.rounding, memory.wanted, memory.branches)
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


@kernel
def add_correction(description: Record, memory: Record, has_near: bool) -> bool:
    """Correct `memory.nominal` to `memory.solution`, both on the turns to command; return whether in limits."""
    arms, q = description.arms, memory.q
    copy(memory.nominal, q)
    nearest_turn(arms, q, description.network.centre, False)  # shifted to the same turns as the training rows
    write_network_correction(description, memory, memory.pose, q)
    for j in range(arms.dof):
        q[j] = memory.nominal[j] + memory.delta[j]
    copy(q, memory.solution)
    inside = wrap_into_limits(arms, memory.solution)
    if has_near:
        nearest_turn(arms, memory.solution, memory.near, True)
    for j in range(arms.dof):
        memory.nominal[j] += memory.solution[j] - q[j]
    return inside


@kernel
def finish_corrected(description: Record, memory: Record, branch: int, inside: bool, out: Array) -> int:
    """Write residuals and domain measure; return the status."""
    arms, form, place = description.arms, description.closed_form, 2 * description.arms.dof
    measure = domain_measure(description, memory)
    out[place + 2] = measure
    _settle(description, memory, out)
    if not inside:
        return arrays.OUTSIDE_LIMITS
    move(description, memory, arrays.NOMINAL, memory.nominal)
    miss(arms, memory, memory.pose, memory.error)
    if is_singular(arms, arms.reach[arrays.NOMINAL], memory.J, tolerances.SINGULAR_TOLERANCE, memory):
        return arrays.SINGULAR
    trained = False
    for index in range(form.trained):
        trained = trained or form.order[index] == branch
    covered = description.network.samples == 0 or (measure <= 1 and trained)
    return arrays.REACHED if covered else arrays.OUTSIDE_DOMAIN


@kernel
def _settle(description: Record, memory: Record, out: Array) -> None:
    """Write the residuals of the pose whose corrected joint values are the solution; NaN if there is none.

    See `model.calibrated_model.CalibratedModel.forward`; the iteration starts at the nominal joint values.
    """
    arms, q, place, moved = description.arms, memory.trial, 2 * description.arms.dof, 0.0
    copy(memory.nominal, q)
    for _ in range(tolerances.FORWARD_ITERATIONS):
        walk(arms, arrays.NOMINAL, q, memory.axes, memory.T)
        write_network_correction(description, memory, memory.T, q)
        moved = 0.0
        for j in range(arms.dof):
            following = memory.solution[j] - memory.delta[j]
            moved = max(moved, abs(following - q[j]))
            q[j] = following
        if moved <= tolerances.FORWARD_TOLERANCE:
            break
    out[place], out[place + 1] = math.nan, math.nan
    if not moved <= tolerances.FORWARD_ACCEPTED:
        return
    walk(arms, arrays.NOMINAL, q, memory.axes, memory.T)
    pose_error(memory.pose, memory.T, memory.R, memory.error)
    write_residuals(arms, memory, memory.error, out)
