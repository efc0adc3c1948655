"""Joint values along a path of poses on as few branches as possible, with a report of every discontinuity."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pisigma.files.errors import PoseError, check_choice
from pisigma.model.inverse.solution import AbstractInverse
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE

Array = Any

JUMP = 1e6
"""Cost of a jump [rad²], equal to 100 million joint motions of 0.1 rad."""
_LIMITS = 1e8
"""Cost of a pose outside joint limits [rad²], equal to 100 jumps."""
_NONE = 1e12
"""Cost of a pose without a solution [rad²], equal to 10,000 poses outside joint limits."""
_SMALL = 0.1
"""Step on a branch below which it is never treated as a jump [rad or m]."""
CHUNK = 8_192
"""Number of steps whose transitions between all pairs of branches are in memory at a time."""
_TURN = 2 * math.pi
_OTHER_BRANCH = 1e4
"""Cost of a start on a branch other than the requested one [rad²], which is lower than the cost of a jump."""
_LATER = 1e-3
"""Cost of a start on a later branch if no branch is requested [rad²], per position in the order of branches."""
_STILL = 1e-9
"""Motion of a joint below which it is treated as at rest [rad or m]."""


@dataclass(frozen=True)
class PathSwitch:
    """A place on a path where the branch changes or the joint values are discontinuous.

    Attributes:
        index: index of the first pose after the discontinuity.
        kind: "branch": change to another branch, continuously through a singular pose or by a jump; "jump": jump on the
            same branch; "turn": a joint is rewound by full turns to stay within its limits; "gap": poses that are not
            reached.
        jump: largest joint motion [rad or m] of the discontinuity; 0 for a continuous change of the branch.
        sentence: a sentence that describes the change or discontinuity.
    """

    index: int
    kind: str
    jump: float
    sentence: str


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint values along a path.

    Attributes:
        solution: solutions of all poses; NaN where a pose is not reached.
        switches: changes of the branch, discontinuities and gaps, in order; empty for a continuous path on one branch.
    """

    solution: Any
    switches: tuple[PathSwitch, ...]


def follow_path(
    ik: AbstractInverse,
    T_base_tool: Array,
    near: Array | None = None,
    branch: str | None = None,
) -> JointPath:
    """Find joint values along a path.

    For arms with a closed-form inverse, dynamic programming chooses the branches of the whole path that have the
    fewest jumps and, among these, the smallest sum of squared joint motions. For other arms, and for redundant
    tasks, every pose is solved starting from the solution of the previous pose.

    Args:
        ik: corrected inverse kinematics.
        T_base_tool: `(poses, 4, 4)` target poses [m].
        near: `(dof,)` joint values [rad or m] of the robot before the path.
        branch: name of the branch to start on, if this causes no jump; without `near` and `branch`, the branch with the
            most training rows.

    Raises:
        PoseError: there are no poses, a matrix is not a valid pose, or `near` or `branch` is invalid.
    """
    T = np.asarray(T_base_tool, dtype=np.float64)
    if T.ndim != 3 or len(T) == 0:
        raise PoseError(
            expected="a path of shape (poses, 4, 4) with at least one pose",
            value=T.shape,
            option="T_base_tool",
        )
    if branch is not None:
        check_choice(PoseError, "branch", branch, ik.branches)
    near_rows = None if near is None else np.asarray(ik.plausible_joints.check_near(near), dtype=np.float64)
    on_branches = ik.closed_form and len(ik.joints) <= ik.task_axes.free.count(False)
    guide = _guide(ik, T, near_rows, branch) if on_branches else _one_by_one(ik, T, near_rows)
    solution = _solve(ik, T, guide, _approaches(guide, near_rows))
    return JointPath(solution, _switches(ik, T, np.asarray(solution.q), solution))


def _solve(
    ik: AbstractInverse,
    T: Array,
    near: Array | None,
    approach: Array | None = None,
) -> Any:
    """Solve poses near joint values, which may belong to a solution far outside the joint limits."""
    return ik(T, near=None if near is None else ik.plausible_joints.clip(near), approach=approach)


def _approaches(q: Array, near: Array | None) -> Array:
    """Return the direction in which every joint moves to its values, `(poses, dof)`: +1 if they increase, else -1.

    A joint that does not move keeps its last direction; the direction is 0 before the first motion.
    """
    first = q[:1] if near is None else near[None]
    step = np.nan_to_num(np.diff(np.concatenate([first, q]), axis=0))  # poses without a solution are skipped
    sides = np.where(np.abs(step) < _STILL, 0.0, np.sign(step))
    moved = np.where(sides != 0, np.arange(len(q))[:, None], -1)
    last = np.maximum.accumulate(moved, axis=0)
    return np.where(last < 0, 0.0, np.take_along_axis(sides, np.maximum(last, 0), axis=0))


def _guide(ik: AbstractInverse, T: Array, near: Array | None, branch: str | None) -> Array:
    """Return the joint values near which all poses are solved: wrapped values of the chosen branches."""
    every = ik.all_branches(T)
    q, status = np.asarray(every.q), np.asarray(every.status)
    reached = np.flatnonzero(np.isfinite(q).all(-1).any(-1))
    if not len(reached):
        return np.tile(np.clip(0.0, ik.limits[:, 0], ik.limits[:, 1]) if near is None else near, (len(T), 1))
    # The cost of starting on each branch follows from the requested branch, the joint motion from `near`, or the usual
    # order.
    first = np.zeros(len(ik.branches))
    for place, index in enumerate(ik.branch_order):
        first[index] = _LATER * place
    if branch is not None:
        first += _OTHER_BRANCH * (np.arange(len(first)) != ik.branches.index(branch))
    elif near is not None:
        first = np.nan_to_num((wrap_motion(q[reached[0]] - near, ik.revolute) ** 2).sum(-1), nan=0.0)
    q, status = q[reached], status[reached]
    chosen = choose_branches(q, status, _jumps(ik, T[reached], q), first, ik.revolute)
    rolled, _ = unwrap_path(q[np.arange(len(q)), chosen], ik.limits, ik.revolute, near)
    # Poses without a solution are guided by the last pose reached before them, or by the first pose reached.
    before = np.maximum(np.searchsorted(reached, np.arange(len(T)), side="right") - 1, 0)
    return rolled[before]


def _jumps(ik: AbstractInverse, T: Array, q: Array) -> Array:
    """Return whether a step on the same branch is a jump `(poses - 1, branches)`; long steps are checked halfway."""
    step = np.abs(wrap_motion(np.diff(q, axis=0), ik.revolute)).max(-1)
    result = np.zeros(step.shape, dtype=bool)
    rows = np.flatnonzero((np.nan_to_num(step, nan=0.0) > 0.1).any(-1))
    if len(rows):
        middle = np.asarray(ik.all_branches(poses_halfway(T[rows], T[rows + 1])).q)
        result[rows] = is_jump(q[rows], middle, q[rows + 1], ik.revolute)
    return result


def _one_by_one(ik: AbstractInverse, T: Array, near: Array | None) -> Array:
    """Solve every pose from the joint values of the previous pose."""
    result, last = np.empty((len(T), len(ik.joints))), near
    for row, wanted in enumerate(T):
        q = np.asarray(_solve(ik, wanted, last).q)
        if np.isfinite(q).all():
            last = q
        result[row] = np.clip(0.0, ik.limits[:, 0], ik.limits[:, 1]) if last is None else last
    return result


def _switches(ik: AbstractInverse, T: Array, q: Array, solution: Any) -> tuple[PathSwitch, ...]:
    reached = np.isfinite(q).all(-1)
    rows = np.flatnonzero(reached)
    status, branch_index = np.asarray(solution.status), np.asarray(solution.branch)
    gaps = np.flatnonzero(np.diff(reached.astype(int), prepend=1) < 0)
    result = [_gap(int(index), status, reached) for index in gaps]
    before, after = rows[:-1], rows[1:]
    step = q[after] - q[before]
    far = np.flatnonzero((np.abs(step).max(-1) > 0.1) | (branch_index[after] != branch_index[before]))
    middle = poses_halfway(T[before[far]], T[after[far]])
    between = q[before[far]] + wrap_motion(step[far], ik.revolute) / 2
    way = np.asarray(_solve(ik, middle, between).q) if len(far) else between
    jumps = is_jump(q[before[far]], way, q[after[far]], ik.revolute)
    for place, jump in zip(far, jumps, strict=True):
        result += _at(
            ik,
            int(after[place]),
            step[place],
            bool(jump),
            int(branch_index[before[place]]),
            int(branch_index[after[place]]),
        )
    return tuple(sorted(result, key=lambda switch: switch.index))


def _at(
    ik: AbstractInverse,
    index: int,
    step: Array,
    jump: bool,
    left: int,
    taken: int,
) -> Sequence[PathSwitch]:
    """Return the discontinuity before a pose; None if there is none."""
    turned = np.abs(step - wrap_motion(step, ik.revolute)) > 1
    names = f"from branch '{ik.branches[left]}' to '{ik.branches[taken]}'"
    if jump:
        joint = int(np.abs(step).argmax())
        kind, where = ("branch", names) if left != taken else ("jump", f"on branch '{ik.branches[taken]}'")
        words = (
            f"the joints jump {where}; {ik.joints[joint]} moves most, by {_amount(ik, joint, step[joint])}"
        )
        return [PathSwitch(index, kind, float(np.abs(step).max()), f"Before pose {index} {words}.")]
    if turned.any():
        joint = int(np.flatnonzero(turned)[0])
        turn = wrap_motion(step, ik.revolute)[joint] - step[joint]
        words = f"{ik.joints[joint]} is rewound by {_amount(ik, joint, turn)} to stay within its limits"
        return [PathSwitch(index, "turn", abs(float(turn)), f"Before pose {index} {words}.")]
    if left != taken:
        words = f"the branch changes {names} continuously, near a singular pose"
        return [PathSwitch(index, "branch", 0.0, f"Before pose {index} {words}.")]
    return []


def _amount(ik: AbstractInverse, joint: int, step: float) -> str:
    return f"{math.degrees(step):.1f} deg" if ik.revolute[joint] else f"{step * 1e3:.1f} mm"


def _gap(index: int, status: Array, reached: Array) -> PathSwitch:
    behind = np.flatnonzero(reached[index:])
    stop = index + int(behind[0]) if len(behind) else len(reached)
    poses = f"Pose {index} is" if stop == index + 1 else f"Poses {index} to {stop - 1} are"
    return PathSwitch(index, "gap", 0.0, f"{poses} not reached: {Status(int(status[index])).name.lower()}.")


def unwrap_path(
    q: Array, limits: Array, revolute: Array, near: Array | None
) -> tuple[Array, list[tuple[int, int]]]:
    """Unwrap the joint values of a path so that they are continuous and stay within their limits.

    Args:
        q: `(poses, dof)` joint values [rad or m] with any wrapping, without NaN.
        limits: `(dof, 2)` joint limits [rad or m].
        revolute: `(dof,)` mask of the revolute joints.
        near: `(dof,)` joint values near which the path should start; None for 0.

    Returns:
        The joint values, and `(pose, joint)` for every joint that must be rewound by full turns before the pose because
        it reaches a limit. A value that cannot be wrapped into the limits remains outside.
    """
    rolled = q.copy()
    rolled[1:] = q[0] + np.cumsum(wrap_motion(np.diff(q, axis=0), revolute), axis=0)
    rewinds: list[tuple[int, int]] = []
    for joint in np.flatnonzero(revolute):
        meant = 0.0 if near is None else float(near[joint])
        rolled[:, joint], breaks = _within(rolled[:, joint], limits[joint, 0], limits[joint, 1], meant)
        rewinds += [(pose, int(joint)) for pose in breaks]
    return rolled, sorted(rewinds)


def _within(values: Array, lower: float, upper: float, meant: float) -> tuple[Array, list[int]]:
    """Return a joint's continuous values, shifted by full turns into its limits, and where the shift changes."""
    result, breaks, start = values.copy(), [], 0
    lower, upper = lower - LIMIT_TOLERANCE, upper + LIMIT_TOLERANCE
    while start < len(values):
        following = values[start:]
        # numbers of turns that keep all values up to this one inside the limits
        highest = np.floor((upper - np.maximum.accumulate(following)) / _TURN)
        lowest = np.ceil((lower - np.minimum.accumulate(following)) / _TURN)
        fits = lowest <= highest
        length = int(fits.argmin()) if not fits.all() else len(following)
        if length == 0:
            turns, length = np.round((meant - following[0]) / _TURN), 1
        else:
            last = length - 1
            turns = np.clip(np.round((meant - following[0]) / _TURN), lowest[last], highest[last])
        result[start : start + length] = following[:length] + turns * _TURN
        if start and abs(result[start] - result[start - 1] - (values[start] - values[start - 1])) > 1:
            breaks.append(start)
        start += length
        meant = result[start - 1]
    return result, breaks


def wrap_motion(step: Array, revolute: Array) -> Array:
    """Wrap joint motions `(..., dof)` [rad or m] of revolute joints to at most half a turn."""
    return step - np.where(revolute, _TURN * np.round(step / _TURN), 0.0)


def is_jump(before: Array, middle: Array, after: Array, revolute: Array) -> Array:
    """Return whether two solutions `(..., dof)` are not connected via the solution of the halfway pose.

    A continuous motion passes near the middle of a step, so that both halves are shorter than three quarters of it. If
    the halfway pose has no solution (NaN), the solutions are not connected.
    """
    whole, first, second = (
        np.abs(wrap_motion(step, revolute)).max(-1)
        for step in (after - before, middle - before, after - middle)
    )
    continuous = (whole <= _SMALL) | ((first <= 0.75 * whole) & (second <= 0.75 * whole))
    return ~continuous


def poses_halfway(T: Array, U: Array) -> Array:
    """Compute poses `(..., 4, 4)` halfway between poses: mean position, and rotation nearest to the mean matrix."""
    mean = (T + U) / 2
    left, _, right = np.linalg.svd(mean[..., :3, :3])
    sign = np.linalg.det(left @ right)
    left[..., :, 2] *= sign[..., None]
    middle = mean.copy()
    middle[..., :3, :3] = left @ right
    return middle


def choose_branches(q: Array, status: Array, jumps: Array, start_cost: Array, revolute: Array) -> Array:
    """Choose the branch of every pose by dynamic programming over all branches.

    The sum of squared joint motions, plus `JUMP` for every jump, is minimised. A pose outside the joint limits costs as
    much as 100 jumps, and a pose without a solution as much as 10,000 poses outside the joint limits.

    Args:
        q: `(poses, branches, dof)` solutions [rad or m]; NaN where a pose has none.
        status: `(poses, branches)`: `Status` of the solutions.
        jumps: `(poses - 1, branches)`: whether a step on the same branch is a jump.
        start_cost: `(branches,)` cost of a start on each branch [rad²].
        revolute: `(dof,)` mask of the revolute joints.

    Returns:
        `(poses,)`: index of the chosen branch of every pose.
    """
    poses, branches = status.shape
    nodes = np.where(status == Status.OUTSIDE_JOINT_LIMITS, _LIMITS, 0.0)
    nodes = np.where(np.isfinite(q).all(-1), nodes, _NONE)
    cost, came = nodes[0] + start_cost, np.zeros((poses, branches), dtype=np.int64)
    for start in range(0, poses - 1, CHUNK):
        stop = min(start + CHUNK, poses - 1)
        moving = _transitions(q[start : stop + 1], jumps[start:stop], revolute)
        for i in range(start, stop):  # every step depends on the previous one
            through = cost[:, None] + moving[i - start]
            came[i + 1] = through.argmin(0)
            cost = through[came[i + 1], np.arange(branches)] + nodes[i + 1]
    chosen = np.empty(poses, dtype=np.int64)
    chosen[-1] = cost.argmin()
    for i in range(poses - 1, 0, -1):
        chosen[i - 1] = came[i, chosen[i]]
    return chosen


def _transitions(q: Array, jumps: Array, revolute: Array) -> Array:
    """Compute the costs `(steps, branches, branches)` of transitions between branches."""
    step = wrap_motion(q[1:, None] - q[:-1, :, None], revolute)
    motion = np.nan_to_num((step**2).sum(-1), nan=0.0)
    far = np.nan_to_num(np.abs(step).max(-1), nan=0.0) > _SMALL
    own = np.arange(q.shape[1])
    far[:, own, own] = jumps
    return motion + JUMP * far
