"""Conversion between the controller's values and the joint values of the DH rows.

    q_dh = f(C · q_controller + b)

The robot's file states C and b. f is the identity, except for joints that are driven by a four-bar linkage.
Files, results of the inverse kinematics and robot programs contain the controller's values; everything else uses DH
values.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from pisigma.files.errors import PoseError, RobotError
from pisigma.robot.row import Row

LIMIT_TOLERANCE = 1e-9
"""Largest excess over a joint limit that is attributed to rounding [rad or m]."""


@dataclass(frozen=True)
class FourBar:
    """A four-bar linkage of ground, crank, coupler and rocker; the rocker is the joint.

    The pivot of the crank is the origin, and that of the rocker is at (ground, 0). The crank end P at the angle ψ and
    the rocker end Q at the angle φ are one coupler length apart (Freudenstein 1955), in the assembly whose bars do not
    cross. With equal opposite sides the linkage is a parallelogram and φ = ψ.

    Attributes:
        ground: distance between the pivots [m].
        crank: length of the driven bar [m].
        coupler: length of the bar between crank and rocker [m].
        rocker: length of the bar that rotates with the joint [m].
        zero: angle ψ of the crank at `C · q_controller + b` = 0 [rad].
    """

    ground: float
    crank: float
    coupler: float
    rocker: float
    zero: float

    def joint_value(self, x: Any) -> Any:
        """Return the joint value [rad] for a crank rotation x [rad]; a parallelogram returns x."""
        return self._other_end(x, self.crank, self.rocker, 1.0)

    def crank_rotation(self, u: Any) -> Any:
        """Return the crank rotation [rad] for a joint value u [rad]; the inverse of `joint_value`."""
        return self._other_end(u, self.rocker, self.crank, -1.0)

    def length_derivatives(self, x: Any) -> tuple[Any, Any, Any]:
        """Return the derivatives of `joint_value` with respect to the bars' lengths, times the lengths [rad]."""
        step, result = 1e-5, []  # central differences, with errors of order step²
        for name in ("crank", "coupler", "rocker"):
            length = getattr(self, name)
            longer, shorter = (replace(self, **{name: length * (1 + h)}) for h in (step, -step))
            result.append((longer.joint_value(x) - shorter.joint_value(x)) / (2 * step))
        first, second, third = result
        return first, second, third

    def _other_end(self, turn: Any, length: float, other: float, side: float) -> Any:
        """Return the rotation [rad] of the bar at the other pivot, which is at `side · ground` along x."""
        xp, angle = _functions(turn), turn + self.zero
        x, y = length * xp.cos(angle) - side * self.ground, length * xp.sin(angle)
        square = x * x + y * y
        cosine = (other**2 + square - self.coupler**2) / (2 * other * square**0.5)
        opened = xp.sign(y) * xp.arccos(cosine)
        change = xp.arctan2(y, x) - side * opened - angle
        return turn + change - 2 * math.pi * xp.round(change / (2 * math.pi))


@dataclass(frozen=True, eq=False)
class Coupling:
    """Axes of the controller, and the relation of the joints of the DH rows to them.

    Attributes:
        axes: axes that the controller commands, with the limits of its values.
        revolute: whether each joint is revolute.
        matrix: `(dof, axes)`: C, [rad or m] of a joint per [rad or m] of an axis.
        offset: `(dof,)`: b [rad or m].
        is_factor_stated: `(dof, axes)`: mask of the axes named in the file's entry of a coupled joint, possibly
            with the factor 0; all False for a joint without an entry.
        four_bars: index and linkage of every joint that is driven by a linkage.
        stops: index and mechanical limits [rad or m] of every joint that has limits in addition to those of the axes.
    """

    axes: tuple[Row, ...]
    revolute: tuple[bool, ...]
    matrix: Float64[np.ndarray, "dof axes"]
    offset: Float64[np.ndarray, " dof"]
    is_factor_stated: Bool[np.ndarray, "dof axes"]
    four_bars: tuple[tuple[int, FourBar], ...] = ()
    stops: tuple[tuple[int, tuple[float, float]], ...] = ()

    def __post_init__(self) -> None:
        """Check that the joint values determine all axes."""
        rank = int(np.linalg.matrix_rank(self.matrix))
        if rank < len(self.axes):
            names = ", ".join(axis.name for axis in self.axes)
            raise RobotError(
                f"the factors of the axes {names} are linearly dependent, so different values give the same pose",
                expected=f"rank {len(self.axes)}",
                value=rank,
                option="coupling",
                remedy="correct the factors",
            )

    @property
    def has_passive_joints(self) -> bool:
        """Whether there are more joints than axes, so that some joints only follow others."""
        return len(self.matrix) > len(self.axes)

    @property
    def limits(self) -> Float64[np.ndarray, "axes 2"]:
        """Lower and upper limit of every axis [rad or m]."""
        return np.array([[axis.lower, axis.upper] for axis in self.axes])

    def to_dh(self, q: Any) -> Any:
        """Convert the controller's values `(*batch, axes)` to DH values `(*batch, dof)`, arrays or tensors [rad or m].

        Raises:
            PoseError: there are more or fewer values than axes.
        """
        return self._by_four_bars(_times(q, self.matrix) + _like(q, self.offset), FourBar.joint_value)

    def to_controller(self, q: Any) -> Any:
        """Convert DH values `(*batch, dof)` to the controller's values `(*batch, axes)`; the inverse of `to_dh`.

        With passive joints this is the least-squares solution.
        """
        driven = self._by_four_bars(q, FourBar.crank_rotation) - _like(q, self.offset)
        return _times(driven, np.linalg.pinv(self.matrix))

    def derivative(self, q: Any) -> Any:
        """Return the derivative of `to_dh` with respect to the controller's values, `(*batch, dof, axes)`."""
        slope = np.broadcast_to(self.matrix, (*np.shape(q)[:-1], *self.matrix.shape)).copy()
        step = 1e-6
        for joint, bar in self.four_bars:
            x = np.asarray(q) @ self.matrix[joint] + self.offset[joint]
            slope[..., joint, :] *= ((bar.joint_value(x + step) - bar.joint_value(x - step)) / (2 * step))[
                ..., None
            ]
        return slope

    def approach_to_dh(self, approach: Any) -> Any:
        """Convert approach directions of axes to those of joints: +1 or -1 if all axes of a joint agree, or 0."""
        return _sides(approach, np.sign(self.matrix))

    def approach_to_controller(self, approach: Any) -> Any:
        """Convert approach directions of joints to those of axes: +1 or -1 if the joints determine them, or 0."""
        return _sides(approach, np.sign(np.round(np.linalg.pinv(self.matrix), 12)))

    def is_within_limits(self, q: Float[np.ndarray, "*batch dof"]) -> Bool[np.ndarray, "*batch"]:
        """Return whether DH values are within the stops, and the controller's within its limits; False for NaN."""
        values, (lower, upper) = self.to_controller(q), self.limits.T
        inside = ((values >= lower - LIMIT_TOLERANCE) & (values <= upper + LIMIT_TOLERANCE)).all(-1)
        for joint, (least, most) in self.stops:
            inside &= (q[..., joint] >= least - LIMIT_TOLERANCE) & (q[..., joint] <= most + LIMIT_TOLERANCE)
        return np.asarray(inside)

    def wrapped_within_limits(
        self, q: Float64[np.ndarray, "rows dof"], near: Float64[np.ndarray, "#rows dof"] | None = None
    ) -> tuple[Float64[np.ndarray, "rows dof"], Bool[np.ndarray, " rows"]]:
        """Shift coupled joints by full turns so that the controller's values are within its limits.

        Args:
            q: DH values [rad or m].
            near: reference values; among the shifts within the limits, the one nearest to them is used. None for the
                smallest shift.

        Returns:
            The shifted DH values, and whether the controller's values are within its limits; rows for which no shift
            achieves this are unchanged.
        """
        turns = 2 * math.pi * self._turns()
        every = q[:, None] + turns
        least = np.abs(turns).sum(-1)[None] if near is None else np.abs(every - near[:, None]).sum(-1)
        inside = self.is_within_limits(every)
        best = np.where(inside, least, math.inf).argmin(1)
        reached: np.ndarray = inside[np.arange(len(q)), best]
        return np.where(reached[:, None], every[np.arange(len(q)), best], q), reached

    def _turns(self) -> Float64[np.ndarray, "turns dof"]:
        """Return all combinations of -1, 0 or 1 full turns [rad] of the coupled revolute joints."""
        shared = (self.matrix != 0).sum(0) > 1
        coupled = ((self.matrix != 0).sum(1) > 1) | (self.matrix[:, shared] != 0).any(1)
        choices = [(-1, 0, 1) if both else (0,) for both in np.logical_and(coupled, self.revolute).tolist()]
        return np.array(list(itertools.product(*choices)), dtype=np.float64)

    def _by_four_bars(self, values: Any, change: Any) -> Any:
        """Replace the values of joints that a linkage drives with a function of linkage and value."""
        if not self.four_bars:
            return values
        bars = dict(self.four_bars)
        columns = [
            change(bars[j], values[..., j]) if j in bars else values[..., j] for j in range(values.shape[-1])
        ]
        return _functions(values).stack(columns, -1)


def dh_limits(coupling: Coupling) -> Float64[np.ndarray, "dof 2"]:
    """Return the smallest and largest DH value of every joint [rad or m] within the controller's limits.

    The limits are infinite for an unlimited joint and for one whose range is empty.

    Raises:
        RobotError: a four-bar linkage does not close everywhere within the limits.
    """
    # Every DH value is a sum over the axes, so it is extreme where every term is extreme, at one of the ends of its
    # axis.
    ends = coupling.matrix[..., None] * np.where(np.isfinite(coupling.limits), coupling.limits, 0.0)
    unbounded = ((coupling.matrix != 0) & ~np.isfinite(coupling.limits).all(1)).any(1)
    lower, upper = ends.min(-1).sum(1) + coupling.offset, ends.max(-1).sum(1) + coupling.offset
    result = np.stack([np.where(unbounded, -np.inf, lower), np.where(unbounded, np.inf, upper)], 1)
    stops = dict(coupling.stops)
    for joint, bar in coupling.four_bars:
        result[joint] = _driven(bar, result[joint], stops.get(joint, (-np.pi, np.pi)), joint)
    for joint, (least, most) in coupling.stops:
        result[joint] = max(least, result[joint, 0]), min(most, result[joint, 1])
    result[result[:, 0] == result[:, 1]] = -np.inf, np.inf
    return result


def _driven(bar: FourBar, turn: np.ndarray, stops: tuple[float, float], joint: int) -> tuple[float, float]:
    """Return the smallest and largest value [rad] of a joint with a linkage, which must close everywhere in between."""
    with np.errstate(invalid="ignore"):  # an arccosine out of range is NaN, which is reported below
        ends = bar.crank_rotation(np.array(stops))
        x = np.linspace(np.fmax(turn[0], ends[0]), np.fmin(turn[1], ends[1]), 181)
        u = bar.joint_value(x)
    if not (np.isfinite(u).all() and (np.diff(np.sign(np.sin(x + bar.zero))) == 0).all()):
        raise RobotError(
            f"the four-bar linkage of joint {joint + 1} does not close, or is stretched, at a value within the limits",
            expected="a linkage that closes within the limits",
            value=joint + 1,
            option="coupling",
            remedy="give the limits of the joint (limits_deg in its entry), or correct the lengths of the linkage",
        )
    return float(u[0]), float(u[-1])


def _functions(values: Any) -> Any:
    """Return the module for functions of the values, numpy or torch."""
    if not hasattr(values, "new_tensor"):
        return np
    import torch

    return torch


def _like(values: Any, constants: np.ndarray) -> Any:
    """Return constants as an array, or as a tensor with the dtype and device of the values."""
    return values.new_tensor(constants) if hasattr(values, "new_tensor") else constants


def _times(values: Any, matrix: np.ndarray) -> Any:
    """Return `matrix · values` along the last axis; a row with a single 1 keeps its value exactly, NaN included.

    Raises:
        PoseError: the last axis of the values does not fit the matrix.
    """
    shape, count = tuple(values.shape), matrix.shape[1]
    if shape[-1:] != (count,):
        expected = f"{count} values along the last axis"
        raise PoseError(
            f"coupled joints: expected {expected}, got the shape {shape}",
            expected=expected,
            value=shape,
            remedy="check whether these are values of the controller's axes or of the DH rows",
        )
    columns: Sequence[Any] = [
        sum(
            (
                (values[..., j] if factor == 1 else factor * values[..., j])
                for j, factor in enumerate(row.tolist())
                if factor
            ),
            start=0.0 * values[..., 0] if not row.any() else 0.0,
        )
        for row in matrix
    ]
    return _functions(values).stack(columns, -1)


def _sides(approach: Any, signs: np.ndarray) -> Any:
    """Return the approach direction, +1 or -1, of a sum of moving values if all of them agree, otherwise 0."""
    count = _like(approach, np.abs(signs).sum(1))
    total = _times(approach, signs)
    return (abs(total) == count) * total / count.clip(1)
