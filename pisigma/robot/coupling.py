"""How the joints of the DH rows follow what a controller counts: the only file that maps one to the other.

    q_dh = f(C · q_controller + b)

C and b are written in the robot's file. f is the identity, except for joints that a four-bar linkage drives.
Files, answers of the inverse kinematics and programs hold the controller's values; everything else holds DH values.
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

SLACK = 1e-9
"""[rad or m] How far a joint value may lie beyond a limit by rounding."""


@dataclass(frozen=True)
class FourBar:
    """A linkage of a ground, a crank, a coupler and a rocker, whose rocker is the joint.

    The pivot of the crank is the origin and that of the rocker lies at (ground, 0). The crank end P at the angle ψ and
    the rocker end Q at the angle φ are one coupler length apart (Freudenstein 1955), assembled without crossing. With
    equal opposite sides it is a parallelogram, φ = ψ.

    Attributes:
        ground: distance of the pivots [m].
        crank: length of the driven bar [m].
        coupler: length of the bar between crank and rocker [m].
        rocker: length of the bar that turns with the joint [m].
        zero: angle ψ of the crank where `C · q_controller + b` is 0 [rad].
    """

    ground: float
    crank: float
    coupler: float
    rocker: float
    zero: float

    def follow(self, x: Any) -> Any:
        """Joint value [rad] at a crank turned by x [rad], 0 where the parallelogram's would be 0."""
        return self._other_end(x, self.crank, self.rocker, 1.0)

    def drive(self, u: Any) -> Any:
        """Turn of the crank [rad] at a joint value u [rad]; the inverse of `follow`."""
        return self._other_end(u, self.rocker, self.crank, -1.0)

    def length_slopes(self, x: Any) -> tuple[Any, Any, Any]:
        """Derivatives of `follow` by crank, coupler and rocker, each times the length itself [rad]."""
        step, result = 1e-5, []
        for name in ("crank", "coupler", "rocker"):
            length = getattr(self, name)
            longer, shorter = (replace(self, **{name: length * (1 + h)}) for h in (step, -step))
            result.append((longer.follow(x) - shorter.follow(x)) / (2 * step))
        first, second, third = result
        return first, second, third

    def _other_end(self, turn: Any, length: float, other: float, side: float) -> Any:
        """Turn of the bar at the other pivot, which is `side · ground` along x."""
        xp, angle = _functions(turn), turn + self.zero
        x, y = length * xp.cos(angle) - side * self.ground, length * xp.sin(angle)
        square = x * x + y * y
        cosine = (other**2 + square - self.coupler**2) / (2 * other * square**0.5)
        opened = xp.sign(y) * xp.arccos(cosine)
        change = xp.arctan2(y, x) - side * opened - angle
        return turn + change - 2 * math.pi * xp.round(change / (2 * math.pi))


@dataclass(frozen=True, eq=False)
class Coupling:
    """What the controller commands, and how the joints of the DH rows follow.

    Attributes:
        axes: what the controller commands, with the limits of its values.
        turning: per joint, whether it turns.
        matrix: `(dof, axes)`: C, [rad or m] of a joint per [rad or m] of an axis.
        offset: `(dof,)`: b [rad or m].
        four_bars: per joint that a linkage drives, its number and the linkage.
        driven: `(dof, axes)`: which axes the entry of a coupled joint names, be it with the factor 0; none of a joint
            without entry.
        stops: per joint that has mechanical limits beside those of the axes, its number and these [rad or m].
    """

    axes: tuple[Row, ...]
    turning: tuple[bool, ...]
    matrix: Float64[np.ndarray, "dof axes"]
    offset: Float64[np.ndarray, " dof"]
    driven: Bool[np.ndarray, "dof axes"]
    four_bars: tuple[tuple[int, FourBar], ...] = ()
    stops: tuple[tuple[int, tuple[float, float]], ...] = ()

    def __post_init__(self) -> None:
        """Check that every axis can be told from the joints."""
        if np.linalg.matrix_rank(self.matrix) < len(self.axes):
            names = ", ".join(axis.name for axis in self.axes)
            raise RobotError(
                f"coupling: different values of the axes {names} give the same pose, since their factors depend on "
                "each other; correct the factors."
            )

    @property
    def passive(self) -> bool:
        """Whether there are joints that follow the others and that no axis of the controller moves alone."""
        return len(self.matrix) > len(self.axes)

    @property
    def limits(self) -> Float64[np.ndarray, "axes 2"]:
        """Lower and upper limit of every axis [rad or m]."""
        return np.array([[axis.lower, axis.upper] for axis in self.axes])

    def to_dh(self, q: Any) -> Any:
        """DH values `(*batch, dof)` at the controller's values `(*batch, axes)`, both [rad or m]; arrays or tensors.

        Raises:
            PoseError: there are more or fewer values than axes.
        """
        return self._by_four_bars(_times(q, self.matrix) + _like(q, self.offset), FourBar.follow)

    def to_controller(self, q: Any) -> Any:
        """The controller's values `(*batch, axes)` at DH values `(*batch, dof)`; the inverse of `to_dh`.

        Where there are passive joints it is the least-squares solution.
        """
        driven = self._by_four_bars(q, FourBar.drive) - _like(q, self.offset)
        return _times(driven, np.linalg.pinv(self.matrix))

    def slope(self, q: Any) -> Any:
        """Derivative of `to_dh` by the controller's values, `(*batch, dof, axes)`."""
        slope = np.broadcast_to(self.matrix, (*np.shape(q)[:-1], *self.matrix.shape)).copy()
        step = 1e-6
        for joint, bar in self.four_bars:
            x = np.asarray(q) @ self.matrix[joint] + self.offset[joint]
            slope[..., joint, :] *= ((bar.follow(x + step) - bar.follow(x - step)) / (2 * step))[..., None]
        return slope

    def approach_to_dh(self, approach: Any) -> Any:
        """From which side the joints come, +1 or -1, where the sides of all axes that move them agree, else 0."""
        return _sides(approach, np.sign(self.matrix))

    def approach_to_controller(self, approach: Any) -> Any:
        """From which side the axes come, where those of the joints say it; else 0."""
        return _sides(approach, np.sign(np.round(np.linalg.pinv(self.matrix), 12)))

    def is_inside(self, q: Float[np.ndarray, "*batch dof"]) -> Bool[np.ndarray, "*batch"]:
        """Whether DH values are within the stops, and the controller's there within its limits; NaN is not."""
        values, (lower, upper) = self.to_controller(q), self.limits.T
        inside = ((values >= lower - SLACK) & (values <= upper + SLACK)).all(-1)
        for joint, (least, most) in self.stops:
            inside &= (q[..., joint] >= least - SLACK) & (q[..., joint] <= most + SLACK)
        return np.asarray(inside)

    def turned_inside(
        self, q: Float64[np.ndarray, "rows dof"], near: Float64[np.ndarray, "#rows dof"] | None = None
    ) -> tuple[Float64[np.ndarray, "rows dof"], Bool[np.ndarray, " rows"]]:
        """Turn joints by full turns so that the controller's values come into its limits, and near to others.

        Args:
            q: DH values [rad or m].
            near: DH values to come near to, as far as the limits allow; None turns as little as possible.

        Returns:
            The DH values, and whether the controller's are within its limits; others are left as they came.
        """
        turns = 2 * math.pi * self._turns()
        every = q[:, None] + turns
        least = np.abs(turns).sum(-1)[None] if near is None else np.abs(every - near[:, None]).sum(-1)
        inside = self.is_inside(every)
        best = np.where(inside, least, math.inf).argmin(1)
        reached: np.ndarray = inside[np.arange(len(q)), best]
        return np.where(reached[:, None], every[np.arange(len(q)), best], q), reached

    def _turns(self) -> Float64[np.ndarray, "turns dof"]:
        """Full turns by -1, 0 or 1 of all joints that are coupled and turn; the others have limits of their own."""
        shared = (self.matrix != 0).sum(0) > 1
        coupled = ((self.matrix != 0).sum(1) > 1) | (self.matrix[:, shared] != 0).any(1)
        choices = [(-1, 0, 1) if both else (0,) for both in np.logical_and(coupled, self.turning).tolist()]
        return np.array(list(itertools.product(*choices)), dtype=np.float64)

    def _by_four_bars(self, values: Any, change: Any) -> Any:
        """The values, those of joints with a linkage changed by it."""
        if not self.four_bars:
            return values
        bars = dict(self.four_bars)
        columns = [
            change(bars[j], values[..., j]) if j in bars else values[..., j] for j in range(values.shape[-1])
        ]
        return _functions(values).stack(columns, -1)


def hull(coupling: Coupling) -> Float64[np.ndarray, "dof 2"]:
    """Smallest and largest DH value of every joint [rad or m] within the controller's limits; infinite of no range."""
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
    """Smallest and largest value [rad] of a joint that a linkage drives, which has to close all the way between."""
    with np.errstate(invalid="ignore"):  # complained of below
        ends = bar.drive(np.array(stops))
        x = np.linspace(np.fmax(turn[0], ends[0]), np.fmin(turn[1], ends[1]), 181)
        u = bar.follow(x)
    if not (np.isfinite(u).all() and (np.diff(np.sign(np.sin(x + bar.zero))) == 0).all()):
        raise RobotError(
            f"coupling: the four-bar linkage of joint {joint + 1} does not close, or stretches out, at a value within "
            "the limits; give the joint stops (limits_deg in its entry), or correct its lengths."
        )
    return float(u[0]), float(u[-1])


def _functions(values: Any) -> Any:
    """The module whose functions take the values."""
    if not hasattr(values, "new_tensor"):
        return np
    import torch

    return torch


def _like(values: Any, constants: np.ndarray) -> Any:
    """Constants as values are: an array, or a tensor of their type on their device."""
    return values.new_tensor(constants) if hasattr(values, "new_tensor") else constants


def _times(values: Any, matrix: np.ndarray) -> Any:
    """`matrix · values` along the last axis; what stands alone stays exactly what it is, NaN included.

    Raises:
        PoseError: there are more or fewer values than the matrix takes.
    """
    shape, wanted = tuple(values.shape), matrix.shape[1]
    if shape[-1:] != (wanted,):
        raise PoseError(
            f"coupled joints: {wanted} values were wanted along the last axis, got the shape {shape}; the controller "
            "counts its axes, and the rows of the description their joints."
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
    """Sides +1 or -1 of what moves by a sum of others, where all of these come from sides that agree, else 0."""
    count = _like(approach, np.abs(signs).sum(1))
    total = _times(approach, signs)
    return (abs(total) == count) * total / count.clip(1)
