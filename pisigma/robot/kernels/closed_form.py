"""Closed-form inverse kinematics of the nominal arm on plain numbers, branch by branch.

The formulas are plain functions in the files of `pisigma.robot.kinematics.closed_form`.
"""

import math
from typing import Any

import numpy as np

from pisigma.robot.kernels.forms import compiled_closed_forms, compiled_plain
from pisigma.robot.kernels.rotations import wrap
from pisigma.robot.kernels.rows import Array, Record, kernel
from pisigma.robot.kinematics.tolerances import LIMIT_TOLERANCE


def _chained() -> Any:
    """Return one function that calls the closed form of an arm."""

    @kernel
    def chain(form: Record, P: Array, only: int, rounding: float, q: Array) -> None:
        pass

    for kind, function in enumerate(compiled_closed_forms().values(), 1):
        chain = _then(chain, compiled_plain(function, kernel), kind)
    return chain


def _then(chain: Any, function: Any, kind: int) -> Any:
    @kernel
    def both(form: Record, P: Array, only: int, rounding: float, q: Array) -> None:
        if form.kind == kind:
            function(form, P, only, rounding, q)
        else:
            chain(form, P, only, rounding, q)

    return both


_solve = _chained()


@kernel
def all_branches(
    arms: Record, form: Record, T: Array, only: int, rounding: float, P: Array, q: Array
) -> None:
    """Write joint values of every branch, the first one NaN if the branch does not reach the pose.

    Args:
        arms: the arms, for limits.
        form: the nominal arm with canonical twists.
        T: target T_base_tool.
        only: the only requested branch, -1 for all, NEAREST for all with the nearest joint values of those that do
            not reach the pose. The first joint value of other branches is NaN.
        rounding: relative size below which the excess of a cosine over 1, or a length, is a rounding error of T.
        P: `(4, 4)`, overwritten.
        q: `(8, dof)`, output [rad or m]: in (-pi, pi], or shifted by a full turn into the limits.
    """
    for branch in range(form.branches):
        q[branch, 0] = math.nan
    _canonical_pose(form, T, P)
    _solve(form, P, only, rounding, q)
    for branch in range(form.branches):
        if math.isnan(q[branch, 0]):
            continue
        for j in range(arms.dof):
            value = form.direction[j] * (form.sign[j] * q[branch, j] - form.offset[j])
            q[branch, j] = wrap(value) if arms.revolute[j] else value
        wrap_into_limits(arms, q[branch])


@kernel
def wrap_into_limits(arms: Record, q: Array) -> bool:
    """Shift joints by full turns into their limits if possible; return whether all are inside."""
    all_inside = True
    for j in range(arms.dof):
        lower, upper = arms.limits[j, 0] - LIMIT_TOLERANCE, arms.limits[j, 1] + LIMIT_TOLERANCE
        if lower <= q[j] <= upper:
            continue
        moved = q[j]
        if arms.revolute[j] and q[j] < lower:
            moved += 2 * math.pi * math.ceil((lower - q[j]) / (2 * math.pi))
        elif arms.revolute[j]:
            moved -= 2 * math.pi * math.ceil((q[j] - upper) / (2 * math.pi))
        if lower <= moved <= upper:
            q[j] = moved
        else:
            all_inside = False
    return all_inside


@kernel
def nearest_turn(arms: Record, q: Array, near: Array, within_limits: bool) -> None:
    """Shift revolute joints by full turns to the values nearest to a reference."""
    for j in range(arms.dof):
        if not arms.revolute[j]:
            continue
        # numpy's floor and ceil return floats, which are infinite for a joint without limits
        turns = np.floor((near[j] - q[j]) / (2 * math.pi) + 0.5)
        if within_limits:
            lowest = np.ceil((arms.limits[j, 0] - LIMIT_TOLERANCE - q[j]) / (2 * math.pi))
            highest = np.floor((arms.limits[j, 1] + LIMIT_TOLERANCE - q[j]) / (2 * math.pi))
            turns = max(min(turns, highest), lowest) if lowest <= highest else 0.0
        if turns != 0.0:
            q[j] += 2 * math.pi * turns


@kernel
def _canonical_pose(form: Record, T: Array, P: Array) -> None:
    """Write the pose of the last joint's rotated frame in the frame before the first joint: `first · T · last`."""
    for i in range(3):
        for k in range(4):
            P[3, k] = form.first[i, 0] * T[0, k] + form.first[i, 1] * T[1, k] + form.first[i, 2] * T[2, k]
        P[3, 3] += form.first[i, 3]
        for k in range(4):
            P[i, k] = P[3, 0] * form.last[0, k] + P[3, 1] * form.last[1, k] + P[3, 2] * form.last[2, k]
        P[i, 3] += P[3, 3]
