"""Tool axes and tolerances of a task, without importing torch."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pisigma.files.errors import PoseError, check_choice

AXES = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names of the motions of the tool along and about its x, y and z axes."""

MAX_TILT = math.radians(10.0)
"""Largest tilt [rad] of the tool of an arm with four joints, whose roll and pitch are free up to this angle."""

_FREE = {3: ("roll", "pitch", "yaw"), 4: ("roll", "pitch"), 5: ("yaw",)}


@dataclass(frozen=True)
class TaskAxes:
    """Requirements of a task on the tool pose, in the axes of the tool frame.

    Position errors are `R^T (p_target - p)` [m] along the axes of the target tool. Rotation errors are the rotation
    from the reached to the target tool [rad], about the axes of the reached tool: a rotation vector or, if one axis
    differs from the other two (`pivot`), the twist about that axis and its swing, so that ignored rotations do not
    affect the others.

    Attributes:
        tolerance: tolerances of `AXES` [m, rad]: 0 for an axis that must be met exactly, infinity for an ignored axis,
            a positive number for a deviation that is accepted if the pose cannot be reached exactly, and a negative
            number for an axis that is free within that deviation.
        elbow_angle: elbow angle of an arm with seven revolute joints [rad], the arm angle of Kreutz-Delgado et al.
            1992: about the line from the shoulder (origin of the second joint's axis) to the wrist (that of the sixth),
            from the plane through this line and the direction of the first axis to the elbow (origin of the fourth
            axis). None if the elbow angle is free.
    """

    tolerance: tuple[float, ...] = (0.0,) * 6
    elbow_angle: float | None = None

    @cached_property
    def ignored(self) -> tuple[str, ...]:
        """Names of the axes that are ignored or free."""
        return tuple(name for name, free in zip(AXES, self.free, strict=True) if free)

    @cached_property
    def free(self) -> tuple[bool, ...]:
        """Mask of the `AXES` that are excluded from least squares and residuals."""
        return tuple(value < 0 or value == math.inf for value in self.tolerance)

    @cached_property
    def is_exact(self) -> bool:
        """Whether all axes must be met exactly."""
        return not any(self.tolerance)

    @property
    def has_tolerances(self) -> bool:
        """Whether some axes have a positive finite tolerance."""
        return any(value != 0 and not free for value, free in zip(self.tolerance, self.free, strict=True))

    def weights(self, joints: int) -> tuple[float, ...]:
        """Return 1 for every axis that an arm with this number of joints can meet exactly, otherwise 0."""
        exact = self.tolerance.count(0.0)
        enough = exact < joints
        return tuple(
            float(value == 0 or (enough and not free))
            for value, free in zip(self.tolerance, self.free, strict=True)
        )

    @property
    def loose_weights(self) -> tuple[float, ...]:
        """Weights in least squares: relative inverse tolerances; exact axes have 1000 times the largest of these."""
        least = min((value for value in self.tolerance if value > 0), default=1.0)
        share = 1e-3 if 0.0 in self.tolerance else 1.0
        return tuple(
            1.0 if value == 0 else 0.0 if free else share * least / value
            for value, free in zip(self.tolerance, self.free, strict=True)
        )

    @property
    def compared_directions(self) -> tuple[bool, ...]:
        """Tool axes whose directions measure the distance between poses; see `StoredStarts.nearest`."""
        counted = self.free.count(False) > 3
        return tuple(self.is_exact or (counted and k == self.pivot) for k in range(3))

    @cached_property
    def pivot(self) -> int:
        """Index (0 to 2) of the axis for splitting rotation errors into twist and swing; -1 for none."""
        turns, free = self.tolerance[3:], self.free[3:]
        if any(free):
            alone = [k for k in range(3) if free.count(free[k]) == 1]
        else:
            exact = [value == 0 for value in turns]
            alone = [k for k in range(3) if exact.count(exact[k]) == 1]
        return alone[0] if alone else -1

    @cached_property
    def row(self) -> Any:
        """Kernel form `(1, 8)`: tolerances, elbow angle (NaN if free) and pivot; `(0, 8)` if all axes are exact."""
        if self.is_exact and self.elbow_angle is None:
            return np.zeros((0, 8))
        elbow = math.nan if self.elbow_angle is None else self.elbow_angle
        return np.array([[*self.tolerance, elbow, self.pivot]])


WHOLE = TaskAxes()
"""Task that requires all six axes to be met exactly."""


def default_axes(joints: int) -> TaskAxes:
    """Return the default task of an arm with the given number of joints: all six axes for six or more.

    With five joints, the rotation about the tool's z axis is free. With four joints, roll and pitch are free up to
    `MAX_TILT`. With three joints, the orientation is ignored.
    """
    free = -MAX_TILT if joints == 4 else math.inf
    return TaskAxes(tuple(free if name in _FREE.get(joints, ()) else 0.0 for name in AXES))


def task_axes(
    defaults: TaskAxes,
    ignore_axes: Sequence[str] | None = None,
    tolerance_mm: float | Sequence[float] | None = None,
    tolerance_deg: float | Sequence[float] | None = None,
    elbow_angle: float | None = None,
) -> TaskAxes:
    """Make the task from a user's options; see `CorrectedIK.__call__`.

    Args:
        defaults: task whose values are used where an option is not stated.
        ignore_axes: names of `AXES` to ignore.
        tolerance_mm: tolerance of x, y and z [mm], one number or three.
        tolerance_deg: tolerance of roll, pitch and yaw [deg], one number or three.
        elbow_angle: elbow angle [rad].

    Raises:
        PoseError: an axis does not exist, or a tolerance is not a number >= 0.
    """
    tolerance = list(defaults.tolerance)
    if ignore_axes is not None:
        names = [ignore_axes] if isinstance(ignore_axes, str) else list(ignore_axes)
        for name in names:
            check_choice(PoseError, "ignore_axes", name, AXES)
        tolerance = [math.inf if name in names else 0.0 for name in AXES]
    for what, stated, unit, first in (
        ("tolerance_mm", tolerance_mm, 1e-3, 0),
        ("tolerance_deg", tolerance_deg, math.pi / 180, 3),
    ):
        if stated is not None:
            for axis, value in enumerate(_three(what, stated), first):
                tolerance[axis] = tolerance[axis] if tolerance[axis] == math.inf else value * unit
    return TaskAxes(tuple(tolerance), defaults.elbow_angle if elbow_angle is None else elbow_angle)


def _three(what: str, stated: float | Sequence[float]) -> list[float]:
    """Return the tolerances of three axes from one number or three numbers.

    Raises:
        PoseError: the option `what` is neither one number >= 0 nor three.
    """
    with suppress(TypeError, ValueError):
        values: list[float] = np.broadcast_to(np.asarray(stated, dtype=float), 3).tolist()
        if all(value >= 0 for value in values):
            return values
    expected = "one number >= 0, or three numbers, one for each axis"
    raise PoseError(f"expected {expected}, got {stated!r}", expected=expected, value=stated, option=what)
