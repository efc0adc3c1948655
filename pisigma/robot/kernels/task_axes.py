"""Pose errors and Jacobians in the tool axes of a task, on plain numbers.

The formulas are explained in `kinematics.task_error`.
"""

import math

from pisigma.robot.kernels.rotations import pose_error, wrap
from pisigma.robot.kernels.rows import Array, Record, copy_rows, fill, kernel

ELBOW = 6
"""Index of the elbow angle, after the six axes."""

_TURNS, _ORIENTATIONS = 12, 24
"""Number of orientations that are tried for a tool that may rotate about one axis, and about two or all axes."""


@kernel
def state_task(arms: Record, memory: Record, reach: float, stated: Array) -> None:
    """Write a task into memory.

    Args:
        arms: the arms.
        memory: working memory.
        reach: characteristic length [m].
        stated: `(0 or 1, 8)`, see `kinematics.task_axes.TaskAxes.row`; without a row all six axes are exact.
    """
    memory.whole, memory.elbow, memory.pivot = 1, math.nan, -1
    fill(memory.tolerance, 0.0)
    for j in range(arms.dof):
        memory.scale[j] = 1.0 if arms.revolute[j] else reach
    if stated.shape[0] > 0:
        for i in range(6):
            memory.tolerance[i] = stated[0, i]
            if stated[0, i] != 0.0:
                memory.whole = 0
        memory.elbow, memory.pivot = stated[0, ELBOW], int(stated[0, 7])
    fill(memory.error, 0.0)
    fill(memory.best, 0.0)
    exact = count_axes(memory, False)
    memory.loose = 0
    if exact < arms.dof and count_axes(memory, True) > arms.dof:
        memory.loose = 1
    use_axes(memory, exact < arms.dof, False)


@kernel
def is_free(tolerance: float) -> bool:
    """Return whether an axis is excluded from least squares: ignored, or free within its negative tolerance."""
    return tolerance < 0.0 or tolerance == math.inf


@kernel
def count_axes(memory: Record, with_tolerances: bool) -> int:
    """Return the number of exact axes, optionally with those within tolerances."""
    count = 0
    for i in range(6):
        if memory.tolerance[i] == 0.0 or (with_tolerances and not is_free(memory.tolerance[i])):
            count += 1
    return count


@kernel
def use_axes(memory: Record, with_tolerances: bool, weighted: bool) -> None:
    """Select the rows of errors and Jacobians in use, and their weights.

    Args:
        memory: working memory.
        with_tolerances: whether to use axes with a tolerance, not only the exact ones.
        weighted: whether to weight them by their inverse tolerances; exact axes then have 1000 times the weight.
    """
    least = math.inf
    for i in range(6):
        if memory.tolerance[i] > 0.0:
            least = min(least, memory.tolerance[i])
    exact = count_axes(memory, False) > 0
    memory.rows, memory.height = 0, 6
    for i in range(6):
        tolerance, weight = memory.tolerance[i], 0.0
        if tolerance == 0.0:
            weight = 1.0
        elif with_tolerances and not is_free(tolerance):
            weight = least / tolerance * (1e-3 if exact else 1.0) if weighted else 1.0
        memory.weight[i] = weight
        if weight > 0.0:
            memory.rows += 1


@kernel
def use_elbow(memory: Record, used: bool) -> None:
    """Add the elbow angle `memory.elbow_now` [rad] to the task, or remove it."""
    if used and memory.height == ELBOW:
        memory.height, memory.rows = ELBOW + 1, memory.rows + 1
    elif not used and memory.height > ELBOW:
        memory.height, memory.rows = ELBOW, memory.rows - 1
        memory.error[ELBOW], memory.best[ELBOW] = 0.0, 0.0


@kernel
def in_task_axes(arms: Record, memory: Record, T: Array, error: Array, raw: bool) -> None:
    """Convert a pose error and the Jacobian in memory to the tool axes in use.

    Args:
        arms: the arms.
        memory: working memory with the reached pose `T`, the Jacobian `J` and the joint axes.
        T: target T_base_tool.
        error: output of `pose_error`; overwritten.
        raw: whether to keep all axes, without weights.
    """
    reached, J, R, e = memory.T, memory.J, memory.R, memory.turned
    _relative(reached, T, R)
    for i in range(3):
        e[i] = T[0, i] * error[0] + T[1, i] * error[1] + T[2, i] * error[2]
        e[3 + i] = reached[0, i] * error[3] + reached[1, i] * error[4] + reached[2, i] * error[5]
    for j in range(arms.dof):
        a, b, c, u, v, w = J[0, j], J[1, j], J[2, j], J[3, j], J[4, j], J[5, j]
        for i in range(3):
            J[i, j] = T[0, i] * a + T[1, i] * b + T[2, i] * c
            J[3 + i, j] = reached[0, i] * u + reached[1, i] * v + reached[2, i] * w
    if memory.pivot >= 0:
        _split(arms, memory, memory.pivot)
    for i in range(6):
        weight = 1.0 if raw else memory.weight[i]
        error[i] = weight * e[i]
        for j in range(arms.dof):
            J[i, j] *= weight
    if memory.height > ELBOW and not raw:
        error[ELBOW] = wrap(memory.elbow_now - elbow_angle(arms, memory))


@kernel
def _relative(reached: Array, T: Array, R: Array) -> None:
    """Write the rotation from the reached to the target tool frame, expressed in the reached frame."""
    for i in range(3):
        for k in range(3):
            R[i, k] = reached[0, i] * T[0, k] + reached[1, i] * T[1, k] + reached[2, i] * T[2, k]


@kernel
def _split(arms: Record, memory: Record, k: int) -> None:
    """Replace the rotation vector in `memory.turned` by the swing of an axis and the twist about it, and convert J."""
    R, e, J = memory.R, memory.turned, memory.J
    i, m = (k + 1) % 3, (k + 2) % 3
    sine = math.sqrt(R[i, k] * R[i, k] + R[m, k] * R[m, k])
    factor = math.atan2(sine, R[k, k]) / sine if sine > 1e-12 else (1.0 if R[k, k] > 0 else 0.0)
    e[3 + i], e[3 + m] = -factor * R[m, k], factor * R[i, k]
    e[3 + k] = math.atan2(R[m, i] - R[i, m], R[i, i] + R[m, m])
    share = 1 / max(1 + R[k, k], 0.05)
    for j in range(arms.dof):
        J[3 + k, j] += share * (R[i, k] * J[3 + i, j] + R[m, k] * J[3 + m, j])


@kernel
def elbow_angle(arms: Record, memory: Record) -> float:
    """Return the elbow angle [rad] about the line from shoulder to wrist, with its derivatives in row `ELBOW` of J.

    See `kinematics.task_axes`. Both refer to the arm whose joint axes are in memory.
    """
    axes, J, w, n, p, t = memory.axes, memory.J, memory.line, memory.upright, memory.bend, memory.lateral
    square, along_n, along_p = 0.0, 0.0, 0.0
    for i in range(3):
        w[i], p[i] = axes[5, 3 + i] - axes[1, 3 + i], axes[3, 3 + i] - axes[1, 3 + i]
        n[i] = axes[0, i]
        square += w[i] * w[i]
    length = math.sqrt(square)
    for i in range(3):
        w[i] /= length
        along_n += w[i] * n[i]
        along_p += w[i] * p[i]
    for i in range(3):
        n[i] -= along_n * w[i]
        p[i] -= along_p * w[i]
    size_n, size_p = math.sqrt(_dot(n, n)), math.sqrt(_dot(p, p))
    _cross(w, n, t)
    angle = math.atan2(_dot(t, p), _dot(n, p))
    # d angle = [t_p · dE - (w · e) t_p · dw] / |p| + (w · n) t_n · dw / |n|, with t = w × p / |p| and w × n / |n|
    for i in range(3):
        t[i] *= along_n / (size_n * size_n)
        n[i] = p[i] / size_p
    _cross(w, n, p)
    for i in range(3):
        n[i] = p[i] / size_p
        t[i] = (t[i] - along_p * n[i]) / length
    for j in range(arms.dof):
        J[ELBOW, j] = arms.direction[j] * (
            _speed(axes, j, 3, n) + _speed(axes, j, 5, t) - _speed(axes, j, 1, n) - _speed(axes, j, 1, t)
        )
    return angle


@kernel
def _speed(axes: Array, joint: int, point: int, along: Array) -> float:
    """Return the velocity of a joint axis's origin along a vector, per motion of another revolute joint."""
    if joint >= point:
        return 0.0
    x, y, z = axes[joint, 0], axes[joint, 1], axes[joint, 2]
    u, v, w = (
        axes[point, 3] - axes[joint, 3],
        axes[point, 4] - axes[joint, 4],
        axes[point, 5] - axes[joint, 5],
    )
    return along[0] * (y * w - z * v) + along[1] * (z * u - x * w) + along[2] * (x * v - y * u)


@kernel
def _dot(a: Array, b: Array) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _cross(a: Array, b: Array, c: Array) -> None:
    c[0], c[1], c[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def miss(arms: Record, memory: Record, T: Array, error: Array) -> None:
    """Write the error of the arm with pose and Jacobian in memory from a target pose, in the axes in use."""
    pose_error(T, memory.T, memory.R, error)
    if not memory.whole or memory.height > ELBOW:
        in_task_axes(arms, memory, T, error, False)


@kernel
def write_residuals(arms: Record, memory: Record, e: Array, out: Array) -> bool:
    """Write distance [m] and angle [rad] of a pose error in the axes in use; return whether it is within tolerances.

    Args:
        arms: the arms.
        memory: working memory with pose and Jacobian of the error; the latter is converted to the tool axes.
        e: output of `pose_error`; overwritten.
        out: output in the entries 2 · dof and 2 · dof + 1.
    """
    place, tolerated = 2 * arms.dof, True
    if not memory.whole:
        in_task_axes(arms, memory, memory.pose, e, True)
        tolerated = is_tolerated(memory, e)
        for i in range(6):
            if is_free(memory.tolerance[i]):
                e[i] = 0.0
    out[place] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    out[place + 1] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    return tolerated


@kernel
def is_tolerated(memory: Record, error: Array) -> bool:
    """Return whether a raw error is within all tolerances."""
    for i in range(6):
        tolerance = abs(memory.tolerance[i])
        if tolerance > 0.0 and abs(error[i]) > tolerance * (1 + 1e-9):
            return False
    return True


@kernel
def level_pose(description: Record, memory: Record) -> bool:
    """Write the pose for the nominal arm into `memory.level`; return whether its tilt is allowed."""
    arms, allowed = description.arms, memory.tolerance
    if arms.dof == 4 and description.closed_form.kind > 0 and allowed[3] != 0.0 and allowed[4] != 0.0:
        lean = _straighten(description.closed_form, memory.pose, memory.level)
        return lean <= max(abs(allowed[3]), abs(allowed[4]))
    copy_rows(memory.pose, memory.level)
    return True


@kernel
def _straighten(form: Record, T: Array, out: Array) -> float:
    """Write the pose rotated about the tool's origin so that the last joint's axis is parallel to the first's.

    A SCARA can reach that pose; its closed form rejects other poses. Return the angle of the rotation [rad].
    """
    v, u = form.first[2], out[3]
    for i in range(3):
        u[i] = T[i, 0] * form.last[0, 2] + T[i, 1] * form.last[1, 2] + T[i, 2] * form.last[2, 2]
    cosine = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    x, y, z = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
    # With w = u × v the rotation from u to v is cos · I + [w] + w wᵀ / (1 + cos); opposite axes have no unique one.
    share = 1 / max(1 + cosine, 1e-6)
    for k in range(4):
        a, b, c = T[0, k], T[1, k], T[2, k]
        out[0, k], out[1, k], out[2, k] = a, b, c
        if k < 3:
            along = share * (x * a + y * b + z * c)
            out[0, k] = cosine * a + y * c - z * b + along * x
            out[1, k] = cosine * b + z * a - x * c + along * y
            out[2, k] = cosine * c + x * b - y * a + along * z
    out[3, 0], out[3, 1], out[3, 2], out[3, 3] = 0.0, 0.0, 0.0, 1.0
    return math.atan2(math.sqrt(x * x + y * y + z * z), cosine)


@kernel
def free_orientations(memory: Record) -> int:
    """Return the number of orientations to try for a tool with free rotations."""
    free = 0
    for k in range(3):
        free += 1 if is_free(memory.tolerance[3 + k]) else 0
    return 1 if free == 0 else _TURNS if free == 1 else _ORIENTATIONS


@kernel
def orient(memory: Record, index: int) -> None:
    """Write the target pose with the tool rotated about its free axes into `memory.level`."""
    free = free_orientations(memory) > _TURNS
    turn, axis = index * 2 * math.pi / _TURNS, max(memory.pivot, 0)
    if free:
        turn, axis = index % 4 * math.pi / 2, 2
    _turned(memory.pose, axis, turn, memory.level)
    if free and index >= 4:
        tilt = index // 4  # 1 to 3 about x, 4 and 5 about y
        copy_rows(memory.level, memory.wanted)
        _turned(
            memory.wanted,
            0 if tilt < 4 else 1,
            (tilt if tilt < 4 else 2 * tilt - 7) * math.pi / 2,
            memory.level,
        )


@kernel
def _turned(T: Array, axis: int, angle: float, out: Array) -> None:
    """Write a pose rotated about one of its axes."""
    copy_rows(T, out)
    u, v, cos, sin = (axis + 1) % 3, (axis + 2) % 3, math.cos(angle), math.sin(angle)
    for i in range(3):
        out[i, u], out[i, v] = cos * T[i, u] + sin * T[i, v], cos * T[i, v] - sin * T[i, u]
