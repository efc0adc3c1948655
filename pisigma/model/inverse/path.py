"""Joint values along a path of poses: one branch as long as possible, and word of every place where that ends."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pisigma.files.errors import PoseError, nearest_choice
from pisigma.model.inverse.solution import AbstractInverse
from pisigma.robot.kinematics.status import Status
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE

Array = Any

JUMP = 1e6
"""[rad²] What a jump counts beside squared joint motions: no path moves as much."""
_LIMITS = 1e8
_NONE = 1e12
_SMALL = 0.1
"""[rad or m] A smaller step on one branch is no jump, whatever lies between."""
CHUNK = 8_192
_TURN = 2 * math.pi
_OTHERS = 1e4
"""[rad²] What it costs to begin on another branch than the wanted one; less than a jump."""
_LATER = 1e-3
"""The same where none is wanted, per place in the order of branches."""
_STILL = 1e-9
"""[rad or m] A joint that moves by less stands still."""


@dataclass(frozen=True)
class PathSwitch:
    """A place on a path where the joints do not simply go on.

    Attributes:
        index: of the first pose behind it.
        kind: "branch": over to another branch, smoothly through a singular pose or by a jump; "jump": by a jump on one
            branch; "turn": a joint turns back by full turns to stay within its limits; "gap": a pose is not reached.
        jump: largest joint motion [rad or m] that the joints make without the path needing it; 0 where it is smooth.
        sentence: all of that in words.
    """

    index: int
    kind: str
    jump: float
    sentence: str


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint values along a path.

    Attributes:
        solution: solutions of all poses, as a call with `near` gives them; NaN where a pose is not reached.
        switches: all places where the joints do not simply go on, in order; empty for a path on one branch.
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

    On arms with a closed form the branches are chosen for the path as a whole, by dynamic programming: as few jumps
    as possible, then as little squared joint motion as possible. On others, and where the task leaves the arm joints to
    spare, every pose is solved from the one before.

    Args:
        ik: the corrected inverse kinematics.
        T_base_tool: `(poses, 4, 4)` [m].
        near: `(dof,)` joint values [rad or m] where the robot is before the path.
        branch: name of the branch to begin on if that costs no jump; with neither it is the one most measured.

    Raises:
        PoseError: a matrix is no pose, there are none, or `near` or `branch` do not fit.
    """
    T = np.asarray(T_base_tool, dtype=np.float64)
    if T.ndim != 3 or len(T) == 0:
        raise PoseError(f"a path of shape (poses, 4, 4) was wanted, got {T.shape}; give at least one pose.")
    if branch is not None and branch not in ik.branches:
        raise PoseError(f"there is no branch '{branch}'; {nearest_choice(branch, ik.branches)}")
    beside = None if near is None else np.asarray(ik.postures.checked(near), dtype=np.float64)
    on_branches = ik.closed_form and len(ik.joints) <= ik.axes.free.count(False)
    guide = _guide(ik, T, beside, branch) if on_branches else _one_by_one(ik, T, beside)
    solution = _solve(ik, T, guide, _approaches(guide, beside))
    return JointPath(solution, _switches(ik, T, np.asarray(solution.q), solution))


def _solve(
    ik: AbstractInverse,
    T: Array,
    near: Array | None,
    approach: Array | None = None,
) -> Any:
    """Solutions near joint values, which may be those of a solution far outside the joint limits."""
    return ik(T, near=None if near is None else ik.postures.clip(near), approach=approach)


def _approaches(q: Array, near: Array | None) -> Array:
    """From which side every joint comes to its values `(poses, dof)`: +1 where they rise, -1 where they fall.

    A joint that does not move keeps the side that it came from; 0 before it has moved at all.
    """
    first = q[:1] if near is None else near[None]
    step = np.nan_to_num(np.diff(np.concatenate([first, q]), axis=0))  # poses without solution say nothing
    sides = np.where(np.abs(step) < _STILL, 0.0, np.sign(step))
    moved = np.where(sides != 0, np.arange(len(q))[:, None], -1)
    last = np.maximum.accumulate(moved, axis=0)
    return np.where(last < 0, 0.0, np.take_along_axis(sides, np.maximum(last, 0), axis=0))


def _guide(ik: AbstractInverse, T: Array, near: Array | None, branch: str | None) -> Array:
    """Joint values near which to solve all poses: of chosen branches, on chosen turns."""
    every = ik.all_branches(T)
    q, status = np.asarray(every.q), np.asarray(every.status)
    reached = np.flatnonzero(np.isfinite(q).all(-1).any(-1))
    if not len(reached):
        return np.tile(np.clip(0.0, ik.limits[:, 0], ik.limits[:, 1]) if near is None else near, (len(T), 1))
    first = np.zeros(len(ik.branches))
    for place, index in enumerate(ik.order):
        first[index] = _LATER * place
    if branch is not None:
        first += _OTHERS * (np.arange(len(first)) != ik.branches.index(branch))
    elif near is not None:
        first = np.nan_to_num((wrapped(q[reached[0]] - near, ik.revolute) ** 2).sum(-1), nan=0.0)
    q, status = q[reached], status[reached]
    chosen = choose_branches(q, status, _jumps(ik, T[reached], q), first, ik.revolute)
    rolled, _ = unroll(q[np.arange(len(q)), chosen], ik.limits, ik.revolute, near)
    before = np.maximum(np.searchsorted(reached, np.arange(len(T)), side="right") - 1, 0)
    return rolled[before]


def _jumps(ik: AbstractInverse, T: Array, q: Array) -> Array:
    """Whether staying on a branch is a jump `(poses - 1, branches)`; long steps are looked at halfway."""
    step = np.abs(wrapped(np.diff(q, axis=0), ik.revolute)).max(-1)
    result = np.zeros(step.shape, dtype=bool)
    rows = np.flatnonzero((np.nan_to_num(step, nan=0.0) > 0.1).any(-1))
    if len(rows):
        middle = np.asarray(ik.all_branches(halfway(T[rows], T[rows + 1])).q)
        result[rows] = is_jump(q[rows], middle, q[rows + 1], ik.revolute)
    return result


def _one_by_one(ik: AbstractInverse, T: Array, near: Array | None) -> Array:
    """Joint values of every pose from those of the pose before."""
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
    status, lies = np.asarray(solution.status), np.asarray(solution.branch)
    gaps = np.flatnonzero(np.diff(reached.astype(int), prepend=1) < 0)
    result = [_gap(int(index), status, reached) for index in gaps]
    before, after = rows[:-1], rows[1:]
    step = q[after] - q[before]
    far = np.flatnonzero((np.abs(step).max(-1) > 0.1) | (lies[after] != lies[before]))
    middle = halfway(T[before[far]], T[after[far]])
    between = q[before[far]] + wrapped(step[far], ik.revolute) / 2
    way = np.asarray(_solve(ik, middle, between).q) if len(far) else between
    jumps = is_jump(q[before[far]], way, q[after[far]], ik.revolute)
    for place, jump in zip(far, jumps, strict=True):
        result += _at(ik, int(after[place]), step[place], bool(jump), lies[before[place]], lies[after[place]])
    return tuple(sorted(result, key=lambda switch: switch.index))


def _at(
    ik: AbstractInverse,
    index: int,
    step: Array,
    jump: bool,
    left: int,
    taken: int,
) -> Sequence[PathSwitch]:
    """What happens before a pose, if anything does."""
    turned = np.abs(step - wrapped(step, ik.revolute)) > 1
    names = f"from branch '{ik.branches[left]}' to '{ik.branches[taken]}'"
    if jump:
        joint = int(np.abs(step).argmax())
        kind, where = ("branch", names) if left != taken else ("jump", f"on branch '{ik.branches[taken]}'")
        words = (
            f"the joints jump {where}, most of all {ik.joints[joint]}, by {_amount(ik, joint, step[joint])}"
        )
        return [PathSwitch(index, kind, float(np.abs(step).max()), f"Before pose {index} {words}.")]
    if turned.any():
        joint = int(np.flatnonzero(turned)[0])
        turn = wrapped(step, ik.revolute)[joint] - step[joint]
        words = f"{ik.joints[joint]} turns back by {_amount(ik, joint, turn)} to stay within its limits"
        return [PathSwitch(index, "turn", abs(float(turn)), f"Before pose {index} {words}.")]
    if left != taken:
        words = f"the path goes over {names} smoothly, close to a singular pose"
        return [PathSwitch(index, "branch", 0.0, f"Before pose {index} {words}.")]
    return []


def _amount(ik: AbstractInverse, joint: int, step: float) -> str:
    return f"{math.degrees(step):.1f} deg" if ik.revolute[joint] else f"{step * 1e3:.1f} mm"


def _gap(index: int, status: Array, reached: Array) -> PathSwitch:
    behind = np.flatnonzero(reached[index:])
    stop = index + int(behind[0]) if len(behind) else len(reached)
    poses = f"Pose {index} is" if stop == index + 1 else f"Poses {index} to {stop - 1} are"
    return PathSwitch(index, "gap", 0.0, f"{poses} not reached: {Status(int(status[index])).name.lower()}.")


def unroll(
    q: Array, limits: Array, revolute: Array, near: Array | None
) -> tuple[Array, list[tuple[int, int]]]:
    """Put the joints of a path on turns so that they go on from pose to pose and stay within their limits.

    Args:
        q: `(poses, dof)` joint values [rad or m] on any turns, none NaN.
        limits: `(dof, 2)` [rad or m].
        revolute: `(dof,)`.
        near: `(dof,)` joint values whose turns the path should begin on, or None: those next to 0.

    Returns:
        The joint values, and `(pose, joint)` where a joint must turn back by full turns before it reaches the pose,
        because a limit is in the way. A value that fits on no turn stays beyond its limit.
    """
    rolled = q.copy()
    rolled[1:] = q[0] + np.cumsum(wrapped(np.diff(q, axis=0), revolute), axis=0)
    rewinds: list[tuple[int, int]] = []
    for joint in np.flatnonzero(revolute):
        meant = 0.0 if near is None else float(near[joint])
        rolled[:, joint], breaks = _within(rolled[:, joint], limits[joint, 0], limits[joint, 1], meant)
        rewinds += [(pose, int(joint)) for pose in breaks]
    return rolled, sorted(rewinds)


def _within(values: Array, lower: float, upper: float, meant: float) -> tuple[Array, list[int]]:
    """One joint's continuous values, moved by turns into its limits; and where that needs another turn than before."""
    result, breaks, start = values.copy(), [], 0
    lower, upper = lower - LIMIT_TOLERANCE, upper + LIMIT_TOLERANCE
    while start < len(values):
        rest = values[start:]
        highest = np.floor((upper - np.maximum.accumulate(rest)) / _TURN)
        lowest = np.ceil((lower - np.minimum.accumulate(rest)) / _TURN)
        fits = lowest <= highest
        length = int(fits.argmin()) if not fits.all() else len(rest)
        if length == 0:
            turns, length = np.round((meant - rest[0]) / _TURN), 1
        else:
            last = length - 1
            turns = np.clip(np.round((meant - rest[0]) / _TURN), lowest[last], highest[last])
        result[start : start + length] = rest[:length] + turns * _TURN
        if start and abs(result[start] - result[start - 1] - (values[start] - values[start - 1])) > 1:
            breaks.append(start)
        start += length
        meant = result[start - 1]
    return result, breaks


def wrapped(step: Array, revolute: Array) -> Array:
    """Joint motions `(..., dof)` [rad or m], those of revolute joints by less than half a turn."""
    return step - np.where(revolute, _TURN * np.round(step / _TURN), 0.0)


def is_jump(before: Array, middle: Array, after: Array, revolute: Array) -> Array:
    """Whether solutions `(..., dof)` do not lead through the one of the pose halfway.

    On the way the joints pass near the middle of a step, so both halves are shorter than three quarters of it; where
    the halfway pose has no solution (NaN) there is no way.
    """
    whole, first, second = (
        np.abs(wrapped(step, revolute)).max(-1) for step in (after - before, middle - before, after - middle)
    )
    continuous = (whole <= _SMALL) | ((first <= 0.75 * whole) & (second <= 0.75 * whole))
    return ~continuous


def halfway(T: Array, U: Array) -> Array:
    """Poses `(..., 4, 4)` halfway between poses: the mean position, and the rotation nearest to the mean of both."""
    mean = (T + U) / 2
    left, _, right = np.linalg.svd(mean[..., :3, :3])
    sign = np.linalg.det(left @ right)
    left[..., :, 2] *= sign[..., None]
    middle = mean.copy()
    middle[..., :3, :3] = left @ right
    return middle


def choose_branches(q: Array, status: Array, jumps: Array, first: Array, revolute: Array) -> Array:
    """The branch of every pose, by dynamic programming over all branches.

    The sum over the path of squared joint motions and `JUMP` for every jump is least; a pose outside joint limits
    counts more than any number of jumps, one without solution more than any number of those.

    Args:
        q: `(poses, branches, dof)` solutions [rad or m], NaN where there is none.
        status: `(poses, branches)`: their `Status`.
        jumps: `(poses - 1, branches)`: whether staying on a branch is a jump.
        first: `(branches,)` what it costs to begin on a branch [rad²].
        revolute: `(dof,)`.

    Returns:
        `(poses,)`: indices of branches.
    """
    poses, branches = status.shape
    nodes = np.where(status == Status.OUTSIDE_JOINT_LIMITS, _LIMITS, 0.0)
    nodes = np.where(np.isfinite(q).all(-1), nodes, _NONE)
    cost, came = nodes[0] + first, np.zeros((poses, branches), dtype=np.int64)
    for start in range(0, poses - 1, CHUNK):
        stop = min(start + CHUNK, poses - 1)
        moving = _transitions(q[start : stop + 1], jumps[start:stop], revolute)
        for i in range(start, stop):  # every pose needs the one before
            through = cost[:, None] + moving[i - start]
            came[i + 1] = through.argmin(0)
            cost = through[came[i + 1], np.arange(branches)] + nodes[i + 1]
    chosen = np.empty(poses, dtype=np.int64)
    chosen[-1] = cost.argmin()
    for i in range(poses - 1, 0, -1):
        chosen[i - 1] = came[i, chosen[i]]
    return chosen


def _transitions(q: Array, jumps: Array, revolute: Array) -> Array:
    """Cost `(steps, branches, branches)` of going from one branch to another."""
    step = wrapped(q[1:, None] - q[:-1, :, None], revolute)
    motion = np.nan_to_num((step**2).sum(-1), nan=0.0)
    far = np.nan_to_num(np.abs(step).max(-1), nan=0.0) > _SMALL
    own = np.arange(q.shape[1])
    far[:, own, own] = jumps
    return motion + JUMP * far
