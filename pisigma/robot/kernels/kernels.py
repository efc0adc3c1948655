"""The only exported function of the kernels, into which all others are compiled."""

import math
from typing import Any, no_type_check

from numba import carray  # type: ignore[attr-defined]

from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.chain import walk_many
from pisigma.robot.kernels.inverse import solve_every, solve_pose
from pisigma.robot.kernels.joint_correction import beyond_measured, move
from pisigma.robot.kernels.rows import Array, Record, fill, kernel
from pisigma.robot.kernels.task_axes import state_task
from pisigma.robot.kinematics.tolerances import POSE_TOLERANCE, POSE_TOLERANCE_SINGLE, ROUNDING_UNITS

Pointer = Any

_EPSILON, _EPSILON_SINGLE = 2.220446049250313e-16, 1.1920928955078125e-07
"""Machine epsilon of float64 and float32."""


@no_type_check
def run(
    description: Pointer,
    memory: Pointer,
    task: int,
    rows: int,
    T: Pointer,
    near: Pointer,
    near_rows: int,
    approach: Pointer,
    approach_rows: int,
    axes: Pointer,
    axes_rows: int,
    branch: int,
    mark: int,
    single: int,
    out: Pointer,
    count: int,
) -> int:
    """Solve poses, evaluate the corrected arm, or compute poses and Jacobians of an arm.

    See `solve_poses`, `evaluate` and `chain.walk_many`.

    Args:
        description: struct of the arm, see `kernels.layout`.
        memory: struct of working memory.
        task: SOLVE, EVALUATE or FORWARD.
        rows: number of poses.
        T: `(rows, 4, 4)`: target poses (input) or poses (output).
        near: `(near_rows, dof)`: reference joint values [rad or m].
        near_rows: 0, 1 or the number of poses.
        approach: `(approach_rows, dof)`: approach directions of the joints, +1 or -1, 0 if not stated.
        approach_rows: 0, 1 or the number of poses.
        axes: `(axes_rows, 8)`: tool axes of the task, see `kinematics.task_axes.TaskAxes.row`.
        axes_rows: 0 if all six are exact, else 1.
        branch: index of the branch, or of the arm to evaluate.
        mark: 1 to mark invalid poses, 0 to stop at the first.
        single: 1 if the poses were rounded to float32, else 0.
        out: output: `(rows, count, 2 · dof + 5)` for SOLVE, `(rows, 7 · dof + 1)` for EVALUATE,
            `(rows · count, 6, dof)` for FORWARD.
        count: number of solutions per pose; for FORWARD 1 to compute Jacobians, else 0.
    """
    arm, work = carray(description, 1)[0], carray(memory, 1)[0]
    dof = arm.arms.dof
    poses, joints = carray(T, (rows, 4, 4)), carray(near, (near_rows, dof))
    if task == arrays.SOLVE:
        sides = carray(approach, (approach_rows, dof))
        solutions = carray(out, (rows, count, 2 * dof + 5))
        stated = carray(axes, (axes_rows, 8))
        return solve_poses(arm, work, poses, joints, sides, stated, branch, mark != 0, single != 0, solutions)
    if task == arrays.EVALUATE:
        sides = carray(approach, (approach_rows, dof))
        return evaluate(arm, work, branch, joints, sides, poses, carray(out, (rows, 7 * dof + 1)))
    walk_many(arm.arms, branch, work, joints, poses, carray(out, (rows * count, 6, dof)))
    return arrays.FINE


@kernel
def solve_poses(
    description: Record,
    memory: Record,
    T: Array,
    near: Array,
    approach: Array,
    axes: Array,
    branch: int,
    mark: bool,
    single: bool,
    out: Array,
) -> int:
    """Solve every pose on the branches for which `out` has space.

    Return -1, or `8 · row + fault` of the first invalid pose if invalid poses are not marked.
    """
    dof, has_near = description.arms.dof, near.shape[0] > 0
    tolerance = POSE_TOLERANCE_SINGLE if single else POSE_TOLERANCE
    state_task(description.arms, memory, description.arms.reach[arrays.IDENTIFIED], axes)
    every = branch == arrays.EVERY_BRANCH and description.closed_form.kind == arrays.NO_CLOSED_FORM
    memory.rounding = ROUNDING_UNITS * (_EPSILON_SINGLE if single else _EPSILON)
    for row in range(T.shape[0]):
        wrong = _check_pose(T[row], tolerance)
        if has_near:
            _take_row(near, row, memory.near, dof)
            if wrong == arrays.FINE:
                wrong = _check_near(memory.near, dof)
        _take_approach(approach, row, memory.approach, dof)
        if wrong != arrays.FINE and not mark:
            return 8 * row + wrong
        for i in range(4):
            for k in range(4):
                memory.pose[i, k] = T[row, i, k]
        if wrong == arrays.FINE and every and not description.network.used:
            solve_every(description, memory, out[row])
            continue
        for index in range(out.shape[1]):
            asked = index if branch == arrays.EVERY_BRANCH else branch
            if wrong == arrays.FINE:
                solve_pose(description, memory, has_near, asked, out[row, index])
            else:
                _mark(description, asked, out[row, index])
    return arrays.FINE


@kernel
def _take_row(values: Array, row: int, target: Array, dof: int) -> None:
    """Copy the row of a pose, or the only row, into `target`."""
    for j in range(dof):
        target[j] = values[row if values.shape[0] > 1 else 0, j]


@kernel
def _take_approach(approach: Array, row: int, target: Array, dof: int) -> None:
    """Copy the approach directions of a pose, which are 0 if not stated."""
    if approach.shape[0] > 0:
        _take_row(approach, row, target, dof)
    else:
        fill(target, 0.0)


@kernel
def _check_pose(T: Array, tolerance: float) -> int:
    """Return the first fault of a pose matrix, in the order in which `se3.check_transforms` checks."""
    total = 0.0
    for i in range(4):
        for k in range(4):
            total += T[i, k] * 0.0
    if total != 0.0:
        return arrays.NOT_FINITE
    for k in range(4):
        if abs(T[3, k] - (1.0 if k == 3 else 0.0)) > tolerance:
            return arrays.LAST_ROW
    for i in range(3):
        for k in range(i + 1):
            product = T[0, i] * T[0, k] + T[1, i] * T[1, k] + T[2, i] * T[2, k]
            if abs(product - (1.0 if i == k else 0.0)) > tolerance:
                return arrays.NOT_ORTHONORMAL
    x = T[1, 0] * T[2, 1] - T[2, 0] * T[1, 1]
    y = T[2, 0] * T[0, 1] - T[0, 0] * T[2, 1]
    z = T[0, 0] * T[1, 1] - T[1, 0] * T[0, 1]
    return arrays.FINE if x * T[0, 2] + y * T[1, 2] + z * T[2, 2] > 0 else arrays.LEFT_HANDED


@kernel
def _check_near(near: Array, dof: int) -> int:
    total = 0.0
    for j in range(dof):
        total += near[j] * 0.0
    return arrays.FINE if total == 0.0 else arrays.NEAR_NOT_FINITE


@kernel
def _mark(description: Record, branch: int, out: Array) -> None:
    """Write the status of an invalid pose."""
    fill(out, math.nan)
    out[out.shape[0] - 2] = arrays.INVALID
    out[out.shape[0] - 1] = description.closed_form.order[0] if branch < 0 else branch


@kernel
def evaluate(
    description: Record, memory: Record, arm: int, q: Array, approach: Array, T: Array, out: Array
) -> int:
    """Write poses at joint values, and rows of Jacobian, correction and excess over measured values; return -1."""
    dof = description.arms.dof
    for row in range(q.shape[0]):
        for j in range(dof):
            memory.q[j] = q[row, j]
        _take_approach(approach, row, memory.approach, dof)
        fill(out[row], 0.0)
        move(description, memory, arm, memory.q)
        if arm == arrays.CORRECTED:
            for j in range(dof):
                out[row, 6 * dof + j] = memory.delta[j]
            out[row, 7 * dof] = beyond_measured(description, memory.q)
        for k in range(4):
            for i in range(3):
                T[row, i, k] = memory.T[i, k]
            T[row, 3, k] = 1.0 if k == 3 else 0.0
        for i in range(6):
            for j in range(dof):
                out[row, i * dof + j] = memory.J[i, j]
    return arrays.FINE
