"""Which axes of the tool a task asks for; known without torch."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pisigma.files.errors import PoseError, nearest_choice

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Motions of the tool along its x, y and z axes, and about its x, y and z axes."""

LEAN = math.radians(10.0)
"""How far the tool of an arm with four joints may lean where its roll and pitch are left to the arm [rad]."""

_FREE = {3: ("roll", "pitch", "yaw"), 4: ("roll", "pitch"), 5: ("yaw",)}


@dataclass(frozen=True)
class TaskAxes:
    """What a task asks of the tool, in the axes of the tool's frame.

    Errors are `R^T (p_wanted - p)` [m] along the wanted tool's axes, and about the axes of the tool reached the
    rotation that brings it to the wanted one [rad]: a rotation vector or, where one axis is unlike the two others
    (`pivot`), the twist about that axis and the swing of it, so that what is ignored has no part in what counts.

    Attributes:
        tolerance: of `AXES` [m, rad]: 0 for an axis that counts exactly, infinity for one that is ignored, a positive
            number for a deviation that is accepted where the pose cannot be reached exactly, and a negative one for an
            axis that is left to the arm as long as it deviates by no more.
        elbow_angle: of an arm with seven revolute joints [rad], counted about the line from the shoulder (the origin
            of the second joint's axis) to the wrist (that of the sixth), from the plane through this line along the
            first joint's axis to the elbow (that of the fourth): the arm angle of Kreutz-Delgado et al. 1992. None
            where any will do.
    """

    tolerance: tuple[float, ...] = (0.0,) * 6
    elbow_angle: float | None = None

    @cached_property
    def ignored(self) -> tuple[str, ...]:
        """Names of the axes that do not count."""
        return tuple(name for name, free in zip(AXES, self.free, strict=True) if free)

    @cached_property
    def free(self) -> tuple[bool, ...]:
        """Which of `AXES` have no part in least squares and residuals."""
        return tuple(value < 0 or value == math.inf for value in self.tolerance)

    @cached_property
    def whole(self) -> bool:
        """Whether all axes count exactly."""
        return not any(self.tolerance)

    @property
    def has_tolerances(self) -> bool:
        """Whether some axes may deviate within tolerances and still count."""
        return any(value != 0 and not free for value, free in zip(self.tolerance, self.free, strict=True))

    def weights(self, joints: int) -> tuple[float, ...]:
        """1 for the axes that an arm can meet exactly: those with tolerances too, if it has joints enough; else 0."""
        exact = self.tolerance.count(0.0)
        enough = exact < joints
        return tuple(
            float(value == 0 or (enough and not free))
            for value, free in zip(self.tolerance, self.free, strict=True)
        )

    @property
    def loose_weights(self) -> tuple[float, ...]:
        """Over their tolerances, the smallest of which has weight 1; exact axes then count a thousand times as much."""
        least = min((value for value in self.tolerance if value > 0), default=1.0)
        share = 1e-3 if 0.0 in self.tolerance else 1.0
        return tuple(
            1.0 if value == 0 else 0.0 if free else share * least / value
            for value, free in zip(self.tolerance, self.free, strict=True)
        )

    @property
    def directions(self) -> tuple[bool, ...]:
        """Of which axes of the tool the direction says how near a pose is; see `StoredStarts.nearest`."""
        counted = self.free.count(False) > 3
        return tuple(self.whole or (counted and k == self.pivot) for k in range(3))

    @cached_property
    def pivot(self) -> int:
        """Index (0 to 2) of the axis that rotation errors are split into twist about and swing of; -1 for none."""
        turns, free = self.tolerance[3:], self.free[3:]
        if any(free):
            alone = [k for k in range(3) if free.count(free[k]) == 1]
        else:
            exact = [value == 0 for value in turns]
            alone = [k for k in range(3) if exact.count(exact[k]) == 1]
        return alone[0] if alone else -1

    @cached_property
    def row(self) -> Any:
        """For the kernels `(1, 8)`: tolerances, elbow angle (NaN for any) and pivot; `(0, 8)` where all axes count."""
        if self.whole and self.elbow_angle is None:
            return np.zeros((0, 8))
        elbow = math.nan if self.elbow_angle is None else self.elbow_angle
        return np.array([[*self.tolerance, elbow, self.pivot]])


WHOLE = TaskAxes()
"""All six axes count exactly."""


def default_axes(joints: int) -> TaskAxes:
    """What is asked of an arm unless a task is stated: all six axes from six joints on.

    With five the tool may turn about its z axis, with four it may also lean by up to `LEAN` (roll and pitch) but not
    turn, and with three its orientation does not count.
    """
    free = -LEAN if joints == 4 else math.inf
    return TaskAxes(tuple(free if name in _FREE.get(joints, ()) else 0.0 for name in AXES))


def task_axes(
    usual: TaskAxes,
    ignore_axes: Sequence[str] | None = None,
    tolerance_mm: float | Sequence[float] | None = None,
    tolerance_deg: float | Sequence[float] | None = None,
    elbow_angle: float | None = None,
) -> TaskAxes:
    """What a task asks for, from how users state it; see `CorrectedIK.__call__`.

    Args:
        usual: what counts where that is not stated.
        ignore_axes: names of `AXES`.
        tolerance_mm: of the first three axes.
        tolerance_deg: of the others.
        elbow_angle: [rad]

    Raises:
        PoseError: there is no such axis, or a tolerance is none.
    """
    tolerance = list(usual.tolerance)
    if ignore_axes is not None:
        names = [ignore_axes] if isinstance(ignore_axes, str) else list(ignore_axes)
        for name in names:
            if name not in AXES:
                raise PoseError(f"ignore_axes: there is no axis '{name}'; {nearest_choice(name, AXES)}")
        tolerance = [math.inf if name in names else 0.0 for name in AXES]
    for what, stated, unit, first in (
        ("tolerance_mm", tolerance_mm, 1e-3, 0),
        ("tolerance_deg", tolerance_deg, math.pi / 180, 3),
    ):
        if stated is not None:
            for axis, value in enumerate(_three(what, stated), first):
                tolerance[axis] = tolerance[axis] if tolerance[axis] == math.inf else value * unit
    return TaskAxes(tuple(tolerance), usual.elbow_angle if elbow_angle is None else elbow_angle)


def _three(what: str, stated: float | Sequence[float]) -> list[float]:
    """A tolerance for each of three axes."""
    with suppress(TypeError, ValueError):
        values: list[float] = np.broadcast_to(np.asarray(stated, dtype=float), 3).tolist()
        if all(value >= 0 for value in values):
            return values
    raise PoseError(f"{what}={stated!r}: give a number of at least 0, or three, one for each axis.")
