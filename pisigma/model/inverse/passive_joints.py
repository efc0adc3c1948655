"""Inverse kinematics of arms with passive joints: Newton steps in the controller's values, which move all joints."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.robot.kinematics import tolerances
from pisigma.robot.kinematics.task_axes import LEAN

STARTS = 4
"""Stored joint values, those whose poses are nearest, that are tried one after the other."""
IGNORED = 1e-6
"""Weight of the rotations about the tool's x and y axes where there are fewer than six axes: too few to choose them, so
that they only decide between joint values that reach all else. The tool may lean by `LEAN` then, and no more."""

Values = Float64[np.ndarray, "rows axes"]
Motion = Callable[[Values], tuple[Any, Any]]
"""Pose `(rows, 4, 4)` and Jacobian `(rows, 6, axes)` of an arm by the controller's values."""


@dataclass(frozen=True, eq=False)
class Reached:
    """What was reached.

    Attributes:
        q: the controller's values [rad or m].
        reached: whether the pose is, in all that the arm can choose.
        position: distance from the wanted position [m].
        rotation: angle to the wanted orientation [rad], of which arms with fewer than six axes choose a part.
    """

    q: Values
    reached: Bool[np.ndarray, " rows"]
    position: Float64[np.ndarray, " rows"]
    rotation: Float64[np.ndarray, " rows"]

    def known(self, values: np.ndarray) -> np.ndarray:
        """Values of every pose, NaN where it is not reached."""
        return np.where(self.reached if values.ndim == 1 else self.reached[:, None], values, np.nan)


def solve(motion: Motion, T: Float64[np.ndarray, "rows 4 4"], start: Values) -> Reached:
    """Bring an arm to poses by damped least squares from given values.

    Args:
        motion: of the arm.
        T: wanted poses T_base_tool [m].
        start: the controller's values to begin with [rad or m].
    """
    q = start.copy()
    weight = np.ones(6)
    weight[3:5] = 1.0 if q.shape[1] >= 6 else IGNORED
    error, J = _errors(motion, T, q)
    for _ in range(tolerances.ITERATIONS):
        A, b = J * weight[:, None], error * weight
        normal = A.mT @ A
        damping = 1e-3 * (b * b).sum(-1) + 1e-15
        normal += damping[:, None, None] * np.eye(q.shape[1])
        step = np.linalg.solve(normal, (A.mT @ b[..., None]))[..., 0]
        q = q + np.clip(step, -0.5, 0.5)
        error, J = _errors(motion, T, q)
        if np.abs(step).max(initial=0.0) < 1e-13:
            break
    reached = np.abs(error * (weight == 1.0)).max(-1) < tolerances.ACCEPTED
    reached &= np.abs(error[:, 3:5]).max(-1) <= LEAN
    return Reached(q, reached, np.linalg.norm(error[:, :3], axis=-1), np.linalg.norm(error[:, 3:], axis=-1))


def solve_from(
    motion: Motion,
    T: Float64[np.ndarray, "rows 4 4"],
    starts: Float64[np.ndarray, "rows tried axes"],
    is_inside: Callable[[Values], Bool[np.ndarray, " rows"]],
) -> Reached:
    """Solve poses from the first of their starts that leads there within the limits, else from one that leads there."""
    result = solve(motion, T, starts[:, 0])
    for tried in starts[:, 1:].swapaxes(0, 1):
        left = ~(result.reached & is_inside(result.q))
        if left.any():
            again, q = solve(motion, T[left], tried[left]), result.q.copy()
            better = again.reached & (is_inside(again.q) | ~result.reached[left])
            q[left] = np.where(better[:, None], again.q, q[left])
            result = solve(motion, T, q)
    return result


def nearest_starts(
    motion: Motion, T: Float64[np.ndarray, "rows 4 4"], starts: Float64[np.ndarray, "starts axes"]
) -> Float64[np.ndarray, "rows tried axes"]:
    """Of stored values, per pose those whose poses are nearest, the nearest first."""
    position = motion(starts)[0][:, :3, 3]
    off = np.linalg.norm(T[:, None, :3, 3] - position, axis=-1)
    return starts[np.argsort(off, axis=1)[:, :STARTS]]


def _errors(motion: Motion, T: Any, q: Values) -> tuple[Any, Any]:
    """What is missing in the tool's axes, [m] and rotation vector [rad], and the Jacobian there."""
    here, J = motion(q)
    R = here[:, :3, :3]
    shift = (R.mT @ (T[:, :3, 3] - here[:, :3, 3])[..., None])[..., 0]
    return np.concatenate([shift, _rotation_vector(R.mT @ T[:, :3, :3])], -1), np.concatenate(
        [R.mT @ J[:, :3], R.mT @ J[:, 3:]], 1
    )


def _rotation_vector(R: Any) -> Any:
    """Rotation vectors [rad] of rotations; near half a turn of the right length, if not in the right direction."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], -1) / 2
    sine, cosine = np.linalg.norm(axis, axis=-1), (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    return axis * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None]
