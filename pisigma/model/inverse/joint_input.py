"""What users give as poses and joint values, as arrays; known without torch."""

from collections.abc import Sequence
from contextlib import suppress
from operator import le
from typing import Any

import numpy as np

from pisigma.files.errors import PoseError
from pisigma.robot.kernels import arrays
from pisigma.robot.kernels.array_kinematics import is_tensor

FAULTS = {
    arrays.NOT_FINITE: "T_base_tool{} has entries that are not finite numbers; give 16 finite numbers.",
    arrays.LAST_ROW: "T_base_tool{} does not end with the row 0 0 0 1; give a homogeneous transform.",
    arrays.NOT_ORTHONORMAL: (
        "T_base_tool{} has a rotation part that is not orthonormal; normalise it or check its source."
    ),
    arrays.LEFT_HANDED: (
        "T_base_tool{} has a left-handed rotation part (determinant -1); a reflection is no pose, check its axes."
    ),
    arrays.NEAR_NOT_FINITE: "near{} holds joint values that are no finite numbers; give a number for every joint.",
}
"""What the kernels find wrong with a pose, or with joint values to be near to."""

_POSES = "homogeneous transforms of shape (*batch, 4, 4)"


def as_array(values: Any) -> Any:
    """The values, of which a tensor becomes an array without its gradients."""
    return values.detach().numpy(force=True) if is_tensor(values) else values


def pose_array(values: Any) -> tuple[Any, bool]:
    """Matrices `(*batch, 4, 4)` as a float64 array, and whether they were rounded to float32 before.

    Raises:
        PoseError: they are no numbers, of another type, or of another shape.
    """
    if is_tensor(values) and str(values.dtype) not in ("torch.float32", "torch.float64"):
        raise PoseError(f"T_base_tool holds {values.dtype}; give float64 or float32, lengths in metres.")
    try:
        given = np.asarray(as_array(values))
        T = given.astype(np.float64, copy=False)
    except (TypeError, ValueError):
        raise PoseError(f"T_base_tool is no array of numbers; give {_POSES}.") from None
    if T.ndim < 2 or T.shape[-2:] != (4, 4):
        raise PoseError(f"T_base_tool has the shape {T.shape}; give {_POSES}.")
    return T, given.dtype == np.float32


def numbers(values: Any, what: str, throw: bool) -> Any:
    """The values as a contiguous float64 array, itself where it is one; NaN for what is none, or a complaint.

    Raises:
        PoseError: they are ragged, or no numbers and `throw`.
    """
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        with suppress(ValueError):  # of ragged values
            if not throw:
                return np.full(np.shape(values), np.nan)
        raise PoseError(f"{what} is no array of numbers; give real numbers, lengths in metres.") from None


def joint_rows(values: Any, batch: tuple[int, ...], what: str, throw: bool, joints: Sequence[str]) -> Any:
    """Joint values, or approaches, as `(1 or poses, dof)`.

    Raises:
        PoseError: they do not fit the joints or the poses, or see `numbers`.
    """
    rows, dof = numbers(values, what, throw), len(joints)
    if rows.shape[-1:] != (dof,):
        raise PoseError(
            f"{what} has the shape {rows.shape}, but the robot has {dof} joints; give a value for each of "
            f"{', '.join(joints)}, once or for every pose."
        )
    if rows.ndim == 1:
        return rows.reshape(1, dof)
    try:
        return np.ascontiguousarray(np.broadcast_to(rows, (*batch, dof))).reshape(-1, dof)
    except ValueError:
        raise PoseError(
            f"{what} has the batch shape {rows.shape[:-1]}, which does not broadcast to {batch} of the poses; give "
            "one row of joint values for each pose, or one for all."
        ) from None


def checked_approach(approach: Any) -> Any:
    """Give back from which sides joints come, if that is what the values say; what is no numbers is left as it came.

    Args:
        approach: +1 or -1 for the side from which a joint comes, 0 where that is not stated; or None.

    Raises:
        PoseError: another number stands there, which a learned backlash would be multiplied by.
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
            f"approach holds {wrong[0]:g}; give +1 (the joint's value grows before it stops), -1 (it falls) or 0 (not "
            "stated) for every joint."
        )
    return values


class Postures:
    """What joint values a robot may be at: a full turn beyond the joint limits at most, or the stroke and 1 m at least.

    Solutions may lie outside the limits, and a robot may stand a little beyond them; what lies farther off is no
    posture of the robot, but a value in degrees or millimetres.
    """

    def __init__(self, limits: np.ndarray, revolute: np.ndarray, joints: Sequence[str]) -> None:
        """Take the joint limits `(dof, 2)` [rad or m], which joints turn, and their names."""
        slack = np.where(revolute, 2 * np.pi, np.maximum(1.0, limits[:, 1] - limits[:, 0]))
        self._limits, self._revolute, self._joints = limits, revolute, tuple(joints)
        self._lowest, self._highest = limits[:, 0] - slack, limits[:, 1] + slack
        self._lows, self._highs = self._lowest.tolist(), self._highest.tolist()

    def clip(self, q: np.ndarray) -> np.ndarray:
        """The postures nearest to joint values `(*batch, dof)` [rad or m]."""
        clipped: np.ndarray = np.clip(q, self._lowest, self._highest)
        return clipped

    def hold(self, values: Sequence[float]) -> bool:
        """Whether joint values `(dof,)` are a posture; several times as fast as the comparison of arrays."""
        return all(map(le, self._lows, values)) and all(map(le, values, self._highs))

    def checked(self, near: Any, throw: bool = True) -> Any:
        """`near` as a float64 array, with NaN for values that are in no posture; what does not fit at all as it came.

        Args:
            near: joint values `(*batch, dof)` [rad or m]: a tensor, an array or nested lists.
            throw: whether to raise instead.

        Raises:
            PoseError: a value is in no posture, and `throw`.
        """
        try:
            values = np.asarray(as_array(near), dtype=np.float64)
        except (TypeError, ValueError):
            return near
        if values.shape[-1:] != (len(self._joints),):
            return values
        if values.ndim == 1 and self.hold(values.tolist()):
            return values
        beyond = (values < self._lowest) | (values > self._highest)
        if not beyond.any():
            return values
        if throw:
            raise PoseError(self._complaint(values, tuple(int(index) for index in np.argwhere(beyond)[0])))
        return np.where(beyond, np.nan, values)

    def _complaint(self, values: np.ndarray, row: tuple[int, ...]) -> str:
        joint = row[-1]
        (low, high), beyond = self._limits[joint], self._highest[joint]
        what, unit = ("a full turn", "rad") if self._revolute[joint] else (f"{beyond - high:g} m", "m")
        return (
            f"near holds {values[row]:g} for joint {self._joints[joint]}, more than {what} beyond its limits "
            f"{low:g} to {high:g} {unit}; give joint values in radians and metres."
        )
