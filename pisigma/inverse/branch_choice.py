"""Which branch to be on at every pose of a path, so that the joints jump as seldom and move as little as possible."""

import math
from typing import Any

import numpy as np

from pisigma.kinematics.status import Status

Array = Any

JUMP = 1e6
"""[rad²] What a jump counts beside squared joint motions: no path moves as much."""
_LIMITS = 1e8
_NONE = 1e12
_SMALL = 0.1
"""[rad or m] A smaller step on one branch is no jump, whatever lies between."""
CHUNK = 8_192


def wrapped(step: Array, revolute: Array) -> Array:
    """Joint motions `(..., dof)` [rad or m], those of revolute joints by less than half a turn."""
    turns = np.round(step / (2 * math.pi))
    return step - np.where(revolute, 2 * math.pi * turns, 0.0)


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
