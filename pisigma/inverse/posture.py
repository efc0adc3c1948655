"""What joint values a robot may be at: the others are in degrees or millimetres."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pisigma.errors import PoseError


class Postures:
    """Joint values that lie a full turn beyond the joint limits at most, or the stroke and 1 m at least.

    Solutions may lie outside the limits, and a robot may stand a little beyond them; what lies farther off is no
    posture of the robot.
    """

    def __init__(self, limits: np.ndarray, revolute: np.ndarray, joints: Sequence[str]) -> None:
        """Take the joint limits `(dof, 2)` [rad or m], which joints turn, and their names."""
        slack = np.where(revolute, 2 * np.pi, np.maximum(1.0, limits[:, 1] - limits[:, 0]))
        self._limits, self._revolute, self._joints = limits, revolute, tuple(joints)
        self._lowest, self._highest = limits[:, 0] - slack, limits[:, 1] + slack
        self._bounds = list(zip(self._lowest.tolist(), self._highest.tolist(), strict=True))

    def clip(self, q: np.ndarray) -> np.ndarray:
        """The postures nearest to joint values `(*batch, dof)` [rad or m]."""
        clipped: np.ndarray = np.clip(q, self._lowest, self._highest)
        return clipped

    def checked(self, near: Any, tensor: bool, throw: bool = True) -> Any:
        """`near`, with NaN for values that are in no posture; what does not fit at all as it came.

        Args:
            near: joint values `(*batch, dof)` [rad or m].
            tensor: whether they are a tensor.
            throw: whether to raise instead.

        Raises:
            PoseError: a value is in no posture, and `throw`.
        """
        try:
            values = near.numpy(force=True) if tensor else np.asarray(near, dtype=np.float64)
        except (TypeError, ValueError):
            return near
        if values.shape[-1:] != (len(self._joints),):
            return near
        if values.ndim == 1 and all(
            low <= value <= high for value, (low, high) in zip(values.tolist(), self._bounds, strict=True)
        ):  # some times as fast as the comparison of arrays
            return near if tensor else values
        beyond = (values < self._lowest) | (values > self._highest)
        if not beyond.any():
            return near if tensor else values
        if throw:
            raise PoseError(self._complaint(values, tuple(int(index) for index in np.argwhere(beyond)[0])))
        marked = np.where(beyond, np.nan, values)
        return near.new_tensor(marked) if tensor else marked

    def _complaint(self, values: np.ndarray, row: tuple[int, ...]) -> str:
        joint = row[-1]
        (low, high), beyond = self._limits[joint], self._highest[joint]
        what, unit = ("a full turn", "rad") if self._revolute[joint] else (f"{beyond - high:g} m", "m")
        return (
            f"near holds {values[row]:g} for joint {self._joints[joint]}, more than {what} beyond its limits "
            f"{low:g} to {high:g} {unit}; give joint values in radians and metres."
        )
