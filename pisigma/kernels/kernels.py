"""The one function that is compiled for calls from Python; everything else is compiled into it."""

import math
from typing import Any, no_type_check

from numba import carray, njit  # type: ignore[attr-defined]

from pisigma.kernels.arrays import BLENDED
from pisigma.kernels.codes import (
    EVERY_BRANCH,
    FINE,
    INVALID,
    LAST_ROW,
    LEFT_HANDED,
    NEAR_NOT_FINITE,
    NOT_FINITE,
    NOT_ORTHONORMAL,
    SOLVE,
)
from pisigma.kernels.inverse import solve_pose
from pisigma.kernels.motion import correct, covered, move
from pisigma.kernels.rows import fill

Array = Any
Record = Any
Pointer = Any

_TOLERANCE = 1e-6


@no_type_check
def run(
    description: Pointer,
    memory: Pointer,
    task: int,
    rows: int,
    T: Pointer,
    near: Pointer,
    near_rows: int,
    branch: int,
    mark: int,
    found: Pointer,
    count: int,
) -> int:
    """Solve poses, or evaluate the arm at joint values; see `solve_poses` and `evaluate`.

    Args:
        description: one struct, see `compiled.layout`.
        memory: one struct to work in.
        task: SOLVE or EVALUATE.
        rows: how many poses.
        T: `(rows, 4, 4)`: wanted poses to read, or poses to write.
        near: `(near_rows, dof)`: joint values.
        near_rows: 0, 1 or as many as poses.
        branch: which branch, or which arm to evaluate.
        mark: 1 to mark what is no pose, 0 to stop there.
        found: `(rows, count, 2 · dof + 5)`, or `(rows, 7 · dof + 1)`, written.
        count: how many solutions a pose gets.
    """
    arm, work = carray(description, 1)[0], carray(memory, 1)[0]
    dof = arm.arms.dof
    poses, joints = carray(T, (rows, 4, 4)), carray(near, (near_rows, dof))
    if task == SOLVE:
        solutions = carray(found, (rows, count, 2 * dof + 5))
        return solve_poses(arm, work, poses, joints, branch, mark != 0, solutions)
    return evaluate(arm, work, branch, joints, poses, carray(found, (rows, 7 * dof + 1)))


@njit(error_model="numpy")
@no_type_check
def solve_poses(
    description: Record, memory: Record, T: Array, near: Array, branch: int, mark: bool, found: Array
) -> int:
    """Solve poses, every one on as many branches as `found` has.

    Gives -1, or `8 · row + what is wrong` with the first bad pose, if these are not to be marked.
    """
    dof, has_near = description.arms.dof, near.shape[0] > 0
    for row in range(T.shape[0]):
        wrong = _check_pose(T[row])
        if has_near:
            for j in range(dof):
                memory.near[j] = near[row if near.shape[0] > 1 else 0, j]
            if wrong == FINE:
                wrong = _check_near(memory.near, dof)
        if wrong != FINE and not mark:
            return 8 * row + wrong
        for i in range(4):
            for k in range(4):
                memory.pose[i, k] = T[row, i, k]
        for place in range(found.shape[1]):
            asked = place if branch == EVERY_BRANCH else branch
            if wrong == FINE:
                solve_pose(description, memory, has_near, asked, found[row, place])
            else:
                _mark(description, asked, found[row, place])
    return FINE


@njit(error_model="numpy")
@no_type_check
def _check_pose(T: Array) -> int:
    """What is wrong with a matrix, in the order in which `se3.check_transforms` looks."""
    total = 0.0
    for i in range(4):
        for k in range(4):
            total += T[i, k] * 0.0
    if total != 0.0:
        return NOT_FINITE
    for k in range(4):
        if abs(T[3, k] - (1.0 if k == 3 else 0.0)) > _TOLERANCE:
            return LAST_ROW
    for i in range(3):
        for k in range(i + 1):
            product = T[0, i] * T[0, k] + T[1, i] * T[1, k] + T[2, i] * T[2, k]
            if abs(product - (1.0 if i == k else 0.0)) > _TOLERANCE:
                return NOT_ORTHONORMAL
    x = T[1, 0] * T[2, 1] - T[2, 0] * T[1, 1]
    y = T[2, 0] * T[0, 1] - T[0, 0] * T[2, 1]
    z = T[0, 0] * T[1, 1] - T[1, 0] * T[0, 1]
    return FINE if x * T[0, 2] + y * T[1, 2] + z * T[2, 2] > 0 else LEFT_HANDED


@njit(error_model="numpy")
@no_type_check
def _check_near(near: Array, dof: int) -> int:
    total = 0.0
    for j in range(dof):
        total += near[j] * 0.0
    return FINE if total == 0.0 else NEAR_NOT_FINITE


@njit(error_model="numpy")
@no_type_check
def _mark(description: Record, branch: int, found: Array) -> None:
    """Say that there is no pose to solve for."""
    fill(found, math.nan)
    found[found.shape[0] - 2] = INVALID
    found[found.shape[0] - 1] = description.closed_form.order[0] if branch < 0 else branch


@njit(error_model="numpy")
@no_type_check
def evaluate(description: Record, memory: Record, arm: int, q: Array, T: Array, found: Array) -> int:
    """Write poses at joint values, and in a row Jacobian, and correction and share of it of BLENDED; gives -1."""
    dof = description.arms.dof
    for row in range(q.shape[0]):
        for j in range(dof):
            memory.q[j] = q[row, j]
        fill(found[row], 0.0)
        if arm == BLENDED:
            correct(description, memory, memory.q)
            for j in range(dof):
                found[row, 6 * dof + j] = memory.delta[j]
            found[row, 7 * dof] = covered(description, memory.q)[0]
        move(description, memory, arm, memory.q)
        for k in range(4):
            for i in range(3):
                T[row, i, k] = memory.T[i, k]
            T[row, 3, k] = 1.0 if k == 3 else 0.0
        for i in range(6):
            for j in range(dof):
                found[row, i * dof + j] = memory.J[i, j]
    return FINE
