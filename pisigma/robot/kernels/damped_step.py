"""Damped least-squares steps, and the distance from a singularity, on plain numbers."""

import math

from pisigma.robot.kernels.rows import Array, Record, contracted_kernel

_FLOOR = 4 * 2.220446049250313e-16
_SWEEPS = 30


@contracted_kernel
def scaled_square(reach: float, error: Array) -> float:
    """Return the squared pose error with translation in characteristic lengths."""
    scale = 1 / (reach * reach)
    position = error[0] * error[0] + error[1] * error[1] + error[2] * error[2]
    rotation = error[3] * error[3] + error[4] * error[4] + error[5] * error[5]
    return scale * position + rotation + error[6] * error[6]


@contracted_kernel
def _scale(arms: Record, reach: float, J: Array, memory: Record) -> None:
    """Write the dimensionless Jacobian A into memory."""
    A, inverse = memory.scaled, 1 / reach
    for j in range(arms.dof):
        length = memory.scale[j]
        for i in range(3):
            A[i, j] = J[i, j] * length * inverse
            A[i + 3, j] = J[i + 3, j] * length
        if memory.height > 6:
            A[6, j] = J[6, j] * length


@contracted_kernel
def _normal(memory: Record, dof: int, by_row: bool, rows: int) -> tuple[int, float]:
    """Write `A A^T` or `A^T A` of the first rows of A; return its size and trace."""
    A, S = memory.scaled, memory.square
    size, trace = rows if by_row else dof, 0.0
    for i in range(size):
        for k in range(i + 1):
            total = 0.0
            if not by_row:
                for m in range(rows):
                    total += A[m, i] * A[m, k]
            else:
                for m in range(dof):
                    total += A[i, m] * A[k, m]
            S[i, k] = total
        trace += S[i, i]
    return size, trace


@contracted_kernel
def _factor(S: Array, size: int) -> float:
    """Compute the Cholesky factor in place, with its inverse diagonal; return the determinant, 0 if it fails."""
    determinant = 1.0
    for j in range(size):
        pivot = S[j, j]
        for k in range(j):
            pivot -= S[j, k] * S[j, k]
        if not pivot > 0.0:
            return 0.0
        determinant *= pivot
        inverse = 1 / math.sqrt(pivot)
        S[j, j] = inverse
        for i in range(j + 1, size):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = total * inverse
    return determinant


@contracted_kernel
def damped_step(arms: Record, reach: float, J: Array, error: Array, damping: float, memory: Record) -> bool:
    """Write the step [rad or m] of `(J^T J + λ) dq = J^T e` into `memory.step`; see `kinematics.numeric`.

    Args:
        arms: the arms.
        reach: characteristic length [m].
        J: Jacobian.
        error: pose error.
        damping: factor of the squared error in λ; λ is kept above the rounding level.
        memory: working memory.

    Returns:
        Whether the step exists.
    """
    A, S, x, dof = memory.scaled, memory.square, memory.right, arms.dof
    by_row = memory.rows <= dof
    _scale(arms, reach, J, memory)
    size, trace = _normal(memory, dof, by_row, memory.height)
    weight = damping * scaled_square(reach, error) + _FLOOR * trace
    for i in range(size):
        S[i, i] += weight
    if _factor(S, size) == 0.0:
        return False
    for i in range(size):
        if not by_row:
            x[i] = A[3, i] * error[3] + A[4, i] * error[4] + A[5, i] * error[5]
            x[i] += (A[0, i] * error[0] + A[1, i] * error[1] + A[2, i] * error[2]) / reach
        else:
            x[i] = error[i] / reach if i < 3 else error[i]
    for i in range(size):
        total = x[i]
        for k in range(i):
            total -= S[i, k] * x[k]
        x[i] = total * S[i, i]
    for i in range(size - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, size):
            total -= S[k, i] * x[k]
        x[i] = total * S[i, i]
    for j in range(dof):
        total = 0.0 if by_row else x[j]
        if by_row:
            for i in range(size):
                total += A[i, j] * x[i]
        memory.step[j] = total * memory.scale[j]
    return True


@contracted_kernel
def is_singular(arms: Record, reach: float, J: Array, tolerance: float, memory: Record) -> bool:
    """Return whether the smallest singular value of the dimensionless Jacobian is below a tolerance.

    Only the axes of the task are used. The determinant of the normal equations divided by the largest possible product
    of the other values is a lower bound, which is sufficient except near singularities.
    """
    rows = _compact(arms, reach, J, memory)
    size, trace = _normal(memory, arms.dof, rows <= arms.dof, rows)
    determinant = _factor(memory.square, size)
    others = (trace / (size - 1)) ** (size - 1) if size > 1 else 1.0
    if determinant > 2 * tolerance * tolerance * others:
        return False
    return _smallest_singular_value(memory.scaled, rows, arms.dof) < tolerance


@contracted_kernel
def singularity_measure(arms: Record, reach: float, J: Array, memory: Record) -> float:
    """Return the smallest singular value of the dimensionless Jacobian in the axes of the task."""
    return _smallest_singular_value(memory.scaled, _compact(arms, reach, J, memory), arms.dof)


@contracted_kernel
def _compact(arms: Record, reach: float, J: Array, memory: Record) -> int:
    """Write the rows of the dimensionless Jacobian in use, except the elbow's; return their number."""
    _scale(arms, reach, J, memory)
    if memory.whole:
        return 6
    count, A = 0, memory.scaled
    for i in range(6):
        if memory.weight[i] > 0.0:
            for j in range(arms.dof):
                A[count, j] = A[i, j]
            count += 1
    return count


@contracted_kernel
def _smallest_singular_value(A: Array, rows: int, dof: int) -> float:
    """Apply one-sided Jacobi rotations to the columns of A, or to its rows if they are fewer; A is overwritten."""
    size, by_column = min(rows, dof), dof <= rows
    length = rows if by_column else dof
    for _ in range(_SWEEPS):
        largest = 0.0
        for i in range(size - 1):
            for k in range(i + 1, size):
                a, b, c = 0.0, 0.0, 0.0
                for m in range(length):
                    u = A[m, i] if by_column else A[i, m]
                    v = A[m, k] if by_column else A[k, m]
                    a += u * u
                    b += v * v
                    c += u * v
                if abs(c) <= 1e-15 * math.sqrt(a * b) or c == 0.0:
                    continue
                largest = max(largest, abs(c) / math.sqrt(a * b))
                zeta = (b - a) / (2 * c)
                tangent = math.copysign(1.0, zeta) / (abs(zeta) + math.sqrt(1 + zeta * zeta))
                cos = 1 / math.sqrt(1 + tangent * tangent)
                sin = cos * tangent
                for m in range(length):
                    if by_column:
                        A[m, i], A[m, k] = cos * A[m, i] - sin * A[m, k], sin * A[m, i] + cos * A[m, k]
                    else:
                        A[i, m], A[k, m] = cos * A[i, m] - sin * A[k, m], sin * A[i, m] + cos * A[k, m]
        if largest < 1e-14:
            break
    least = math.inf
    for i in range(size):
        total = 0.0
        for m in range(length):
            value = A[m, i] if by_column else A[i, m]
            total += value * value
        least = min(least, total)
    return math.sqrt(least)
