"""On which turn every joint is along a path."""

import math
from typing import Any

import numpy as np

from pisigma.inverse.branch_choice import wrapped

Array = Any

_TOLERANCE = 1e-9
_TURN = 2 * math.pi


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
    found, breaks, start = values.copy(), [], 0
    lower, upper = lower - _TOLERANCE, upper + _TOLERANCE
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
        found[start : start + length] = rest[:length] + turns * _TURN
        if start and abs(found[start] - found[start - 1] - (values[start] - values[start - 1])) > 1:
            breaks.append(start)
        start += length
        meant = found[start - 1]
    return found, breaks
