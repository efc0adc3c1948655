"""Damped Gauss-Newton iteration from a start to a pose, on plain numbers."""

import math

from pisigma.robot.kernels.arrays import CORRECTED, IDENTIFIED
from pisigma.robot.kernels.damped_step import damped_step, scaled_square
from pisigma.robot.kernels.joint_correction import correct, correction_slope, move
from pisigma.robot.kernels.rotations import pose_error
from pisigma.robot.kernels.rows import Array, Record, copy, copy_rows, fill, kernel
from pisigma.robot.kernels.task_axes import count_axes, in_task_axes, is_tolerated, miss, use_axes
from pisigma.robot.kinematics import tolerances

_CLOSE, _LAST, _SETTLED = 0.05, 1e-15, 3e-12
"""Squared errors [reach or rad]: from _CLOSE**2 on quick steps are tried; below _LAST one more step is exact.
_SETTLED: the iteration ends when joint values [rad or m] move less."""


@kernel
def within(error: Array, position: float, rotation: float) -> bool:
    """Return whether an error is below a distance [m] and an angle [rad], including the elbow angle."""
    linear = error[0] * error[0] + error[1] * error[1] + error[2] * error[2]
    angular = error[3] * error[3] + error[4] * error[4] + error[5] * error[5] + error[6] * error[6]
    return linear < position * position and angular < rotation * rotation


@kernel
def newton(description: Record, memory: Record, arm: int, T: Array, q: Array, tolerance: float) -> None:
    """Move q to a pose like `kinematics.numeric.solve_numeric`; the residual error is in `memory.best`.

    Args:
        description: the calibrated arm.
        memory: working memory.
        arm: index of the arm.
        T: target T_base_tool.
        q: initial joint values [rad or m], overwritten by the best found.
        tolerance: residuals at convergence [m and rad].
    """
    arms, dof = description.arms, description.arms.dof
    reach = arms.reach[IDENTIFIED if arm == CORRECTED else arm]
    _move_steeply(description, memory, arm, q)
    miss(arms, memory, T, memory.best)
    copy_rows(memory.J, memory.J_best)
    old, damping, stalled = scaled_square(reach, memory.best), tolerances.INITIAL_DAMPING, 0
    for _ in range(tolerances.MAX_ITERATIONS):
        if within(memory.best, tolerance, tolerance) or damping > tolerances.MAX_DAMPING:
            break
        possible = damped_step(arms, reach, memory.J_best, memory.best, damping, memory)
        new = math.inf
        if possible:
            for j in range(dof):
                memory.trial[j] = q[j] + memory.step[j]
            _move_steeply(description, memory, arm, memory.trial)
            miss(arms, memory, T, memory.error)
            new = scaled_square(reach, memory.error)
        if new < old:
            stalled = stalled + 1 if new > tolerances.STALL_RATIO * old else 0
            if stalled == tolerances.MAX_STALLED:
                break
            old = new
            copy(memory.trial, q)
            copy(memory.error, memory.best)
            copy_rows(memory.J, memory.J_best)
            damping = max(damping * tolerances.DAMPING_DOWN, tolerances.MIN_DAMPING)
        else:
            damping *= tolerances.DAMPING_UP


@kernel
def _move_steeply(description: Record, memory: Record, arm: int, q: Array) -> None:
    """Call `move`, and include the derivative of the correction in the Jacobian of a corrected arm."""
    move(description, memory, arm, q)
    dof = description.arms.dof
    if arm != CORRECTED or dof > 6:
        return  # for a redundant arm it would lead to a different solution than in torch
    correction_slope(description.arms, description.correction, memory, q)
    for j in range(dof):
        for i in range(6):
            memory.J[i, j] *= 1 + memory.slope[j]


@kernel
def search(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Move q to a pose of the calibrated arm in the axes of the task; return whether that succeeded.

    Axes with tolerances are first met exactly if the arm has enough joints, then by least squares weighted by their
    tolerances.
    """
    if memory.whole:
        return _search_exactly(description, memory, T, q)
    copy(q, memory.first)
    if not memory.loose and _search_exactly(description, memory, T, q):
        return _is_tolerable(description, memory, T, q)
    exact = count_axes(memory, False)
    if exact >= description.arms.dof or count_axes(memory, True) == exact:
        return False
    copy(memory.first, q)
    return _search_loosely(description, memory, T, q) and _is_tolerable(description, memory, T, q)


@kernel
def _is_tolerable(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Return whether joint values are within the tolerances of all axes."""
    move(description, memory, CORRECTED if description.arms.corrected else IDENTIFIED, q)
    pose_error(T, memory.T, memory.R, memory.error)
    in_task_axes(description.arms, memory, T, memory.error, True)
    fill(memory.checked, math.nan)
    return is_tolerated(memory, memory.error)


@kernel
def _search_loosely(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Minimise weighted deviations, then meet the exact axes without deviation."""
    arm = CORRECTED if description.arms.corrected else IDENTIFIED
    fill(memory.checked, math.nan)
    use_axes(memory, True, True)
    newton(description, memory, IDENTIFIED, T, q, tolerances.TOLERANCE)
    newton(description, memory, arm, T, q, tolerances.TOLERANCE)
    use_axes(memory, False, False)
    newton(description, memory, arm, T, q, tolerances.HYBRID_TOLERANCE)
    use_axes(memory, True, False)
    return within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED)


@kernel
def _search_exactly(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Move q to a pose in the axes in use without deviation.

    The arm is solved first without the correction, then with it, because the corrected arm may reach slightly
    farther; if the start is near, a shorter iteration leads to the same joint values.
    """
    arms = description.arms
    fill(memory.checked, math.nan)
    if arms.dof <= 6:
        copy(q, memory.start)
        if _quick(description, memory, T, q):
            return True
        copy(memory.start, q)
    newton(description, memory, IDENTIFIED, T, q, tolerances.TOLERANCE)
    if not arms.corrected:
        return within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED)
    if not within(memory.best, tolerances.NEAR_MISS * arms.reach[IDENTIFIED], tolerances.NEAR_MISS):
        return False
    newton(description, memory, CORRECTED, T, q, tolerances.HYBRID_TOLERANCE)
    return within(memory.best, tolerances.ACCEPTED, tolerances.ACCEPTED)


@kernel
def _quick(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Solve for `q + Δ(q)` by Newton steps, then for q by fixed-point steps; return whether q reaches the pose.

    This is used only if the solution is near the start, because the correction is then not needed in Newton steps.
    """
    arms, dof = description.arms, description.arms.dof
    if not _converge(description, memory, T, q):
        return False
    if not arms.corrected:
        move(description, memory, IDENTIFIED, q)
        miss(arms, memory, T, memory.error)
        return _checked(memory, q, tolerances.TOLERANCE * 4)
    copy(q, memory.trial)
    before = 1.0
    for attempt in range(20):
        correct(description, memory, q)
        if attempt == 0:
            correction_slope(arms, description.correction, memory, q)
        moved = 0.0
        for j in range(dof):
            step = (memory.trial[j] - memory.theta[j]) / (1 + memory.slope[j])
            moved = max(moved, abs(step))
            q[j] += step
        ratio = moved / before
        if moved * ratio < _SETTLED or ratio > 0.5:
            break
        before = moved
    move(description, memory, CORRECTED, q)
    miss(arms, memory, T, memory.error)
    return _checked(memory, q, tolerances.ACCEPTED)


@kernel
def _checked(memory: Record, q: Array, tolerance: float) -> bool:
    """Return whether the pose is reached; if so, mark pose, Jacobian and error in memory as those of q."""
    if not within(memory.error, tolerance, tolerance):
        return False
    copy(q, memory.checked)
    return True


@kernel
def _converge(description: Record, memory: Record, T: Array, q: Array) -> bool:
    """Perform Newton steps of the identified arm while each reduces the error strongly."""
    arms, dof = description.arms, description.arms.dof
    reach, before = arms.reach[IDENTIFIED], _CLOSE * _CLOSE
    for _ in range(8):
        move(description, memory, IDENTIFIED, q)
        miss(arms, memory, T, memory.error)
        square = scaled_square(reach, memory.error)
        if not square < before:
            return square < 1e-26
        if square < 1e-30:
            return True
        if not damped_step(arms, reach, memory.J, memory.error, tolerances.INITIAL_DAMPING, memory):
            return False
        for j in range(dof):
            q[j] += memory.step[j]
        if square < _LAST:
            return True
        before = square * 0.25
    return False
