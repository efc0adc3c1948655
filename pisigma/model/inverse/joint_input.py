"""Check and convert the poses and joint values that users pass, without importing torch."""

from collections.abc import Sequence
from contextlib import suppress
from operator import le
from typing import Any, NamedTuple

import numpy as np

from pisigma.files.errors import PoseError
from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.array_kinematics import is_tensor


class _Fault(NamedTuple):
    """Requirement that an argument does not meet, and a remedy."""

    option: str
    expected: str
    remedy: str


_FAULTS = {
    arrays.NOT_FINITE: _Fault("T_base_tool", "finite entries", "check the source of the pose"),
    arrays.LAST_ROW: _Fault("T_base_tool", "the last row 0 0 0 1", "give a homogeneous transform"),
    arrays.NOT_ORTHONORMAL: _Fault(
        "T_base_tool", "an orthonormal rotation part", "normalise it or check its source"
    ),
    arrays.LEFT_HANDED: _Fault(
        "T_base_tool", "a right-handed rotation part (determinant +1)", "check the direction of its axes"
    ),
    arrays.NEAR_NOT_FINITE: _Fault("near", "finite joint values", "give a number for every joint"),
}
"""Faults of a pose, or of the joint values `near`, by the code that the kernels return."""

_POSES = "homogeneous transforms of shape (*batch, 4, 4)"
_METRES = "an array of real numbers with lengths in metres"


def fault_error(code: int, index: tuple[int, ...] = ()) -> PoseError:
    """Return the error for a fault that the kernels found, at an index of the batch."""
    option, expected, remedy = _FAULTS[code]
    at = f" at index {index if len(index) > 1 else index[0]}" if index else ""
    return PoseError(f"expected {expected}{at}", expected=expected, option=option, remedy=remedy)


def as_array(values: Any) -> Any:
    """Return a tensor as an array without gradients; other values are returned unchanged."""
    return values.detach().numpy(force=True) if is_tensor(values) else values


def pose_array(values: Any) -> tuple[Any, bool, Any]:
    """Return matrices `(*batch, 4, 4)` as a float64 array.

    Returns:
        The array, whether the matrices were float32, and the original tensor or None.

    Raises:
        PoseError: the matrices are not numbers, or have a wrong type or shape.
    """
    tensor = values if is_tensor(values) else None
    if tensor is not None and str(tensor.dtype) not in ("torch.float32", "torch.float64"):
        raise PoseError(
            expected="float64 or float32 values with lengths in metres",
            value=values.dtype,
            option="T_base_tool",
        )
    try:
        given = np.asarray(values if tensor is None else tensor.detach().numpy(force=True))
        T = given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise PoseError(
            "expected an array of real numbers",
            expected=_METRES,
            option="T_base_tool",
            remedy=f"give {_POSES}",
        ) from None
    if T.ndim < 2 or T.shape[-2:] != (4, 4):
        raise PoseError(expected=_POSES, value=T.shape, option="T_base_tool")
    return T, given.dtype == np.float32, tensor


def as_float_array(values: Any, value_name: str, throw: bool) -> Any:
    """Return values as a contiguous float64 array, without a copy if possible.

    Values that are not numbers become NaN if `throw` is False.

    Raises:
        PoseError: the values are ragged, or they are not numbers and `throw` is True.
    """
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        with suppress(ValueError):  # NumPy raises this for ragged values
            if not throw:
                return np.full(np.shape(values), np.nan)
        raise PoseError(expected=_METRES, option=value_name) from None


def joint_rows(
    values: Any, batch: tuple[int, ...], value_name: str, throw: bool, joints: Sequence[str]
) -> Any:
    """Return joint values or approach directions with the shape `(1 or poses, dof)`.

    Raises:
        PoseError: the shape does not match the joints or the poses, or the values are not numbers (`as_float_array`).
    """
    rows, dof = as_float_array(values, value_name, throw), len(joints)
    if rows.shape[-1:] != (dof,):
        raise PoseError(
            f"expected {dof} columns, got shape {rows.shape}",
            expected=f"{dof} columns",
            value=rows.shape,
            option=value_name,
            remedy=f"give a value for each of the joints {', '.join(joints)}, once or for every pose",
        )
    if rows.ndim == 1:
        return rows.reshape(1, dof)
    try:
        return np.ascontiguousarray(np.broadcast_to(rows, (*batch, dof))).reshape(-1, dof)
    except ValueError:
        raise PoseError(
            expected=f"a batch shape that broadcasts to {batch} of the poses",
            value=rows.shape[:-1],
            option=value_name,
            remedy="give one row for each pose, or one for all",
        ) from None


def checked_approach(approach: Any) -> Any:
    """Check the approach directions of joints; values that are not numbers are returned unchanged.

    Args:
        approach: +1 or -1 for the direction in which a joint moves before it stops, 0 if not stated; or None.

    Raises:
        PoseError: a value is a different number, which would scale the learned backlash.
    """
    if approach is None:
        return None
    try:
        values = np.asarray(as_array(approach), dtype=np.float64)
    except (TypeError, ValueError):
        return approach
    wrong = values[~np.isin(values, (-1.0, 0.0, 1.0))]
    if wrong.size:
        raise PoseError(
            expected="+1 (the joint's value increases before it stops), -1 (it decreases) or 0 (not stated)",
            value=float(wrong[0]),
            option="approach",
        )
    return values


class PlausibleJoints:
    """Joint values that are plausible for a robot: at most one turn beyond the joint limits.

    For prismatic joints, the margin is the stroke, but at least 1 m. Solutions, and a real robot, may be somewhat
    outside the joint limits; values farther outside are presumably in degrees or millimetres by mistake.
    """

    def __init__(self, limits: np.ndarray, revolute: np.ndarray, joints: Sequence[str]) -> None:
        """Store the joint limits `(dof, 2)` [rad or m], the mask of revolute joints, and the names of the joints."""
        slack = np.where(revolute, 2 * np.pi, np.maximum(1.0, limits[:, 1] - limits[:, 0]))
        self._limits, self._revolute, self._joints = limits, revolute, tuple(joints)
        self._lowest, self._highest = limits[:, 0] - slack, limits[:, 1] + slack
        self._lows, self._highs = self._lowest.tolist(), self._highest.tolist()

    def clip(self, q: np.ndarray) -> np.ndarray:
        """Return joint values `(*batch, dof)` [rad or m] clipped to plausible values."""
        clipped: np.ndarray = np.clip(q, self._lowest, self._highest)
        return clipped

    def contains(self, values: Sequence[float]) -> bool:
        """Return whether joint values `(dof,)` are plausible, several times as fast as a comparison of arrays."""
        return all(map(le, self._lows, values)) and all(map(le, values, self._highs))

    def check_near(self, near: Any, throw: bool = True) -> Any:
        """Return `near` as a float64 array with NaN for implausible values.

        Values that are not numbers, or have a different shape, are returned unchecked.

        Args:
            near: joint values `(*batch, dof)` [rad or m]: a tensor, an array or nested lists.
            throw: whether to raise an error for implausible values.

        Raises:
            PoseError: a value is implausible and `throw` is True.
        """
        try:
            values = np.asarray(as_array(near), dtype=np.float64)
        except (TypeError, ValueError):
            return near
        if values.shape[-1:] != (len(self._joints),):
            return values
        if values.ndim == 1 and self.contains(values.tolist()):
            return values
        beyond = (values < self._lowest) | (values > self._highest)
        if not beyond.any():
            return values
        if throw:
            raise self._error(values, tuple(int(index) for index in np.argwhere(beyond)[0]))
        return np.where(beyond, np.nan, values)

    def _error(self, values: np.ndarray, row: tuple[int, ...]) -> PoseError:
        joint = row[-1]
        (low, high), beyond = self._limits[joint], self._highest[joint]
        what, unit = ("a full turn", "rad") if self._revolute[joint] else (f"{beyond - high:g} m", "m")
        return PoseError(
            f"{values[row]:g} {unit} for joint {self._joints[joint]} is more than {what} outside its limits {low:g} to "
            f"{high:g} {unit}",
            value=float(values[row]),
            option="near",
            remedy="give joint values in radians and metres",
        )
