"""DH and Hayati rows, their parameters and their joints, in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

JointType = Literal["revolute", "prismatic", "fixed"]

DH_COLUMNS = ("theta", "d", "a", "alpha", "beta")
"""Names and order of the parameters of a row; theta, alpha, beta [rad], d, a [m]."""

FRAME_COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw")
"""Names and order of the parameters of base and tool; x, y, z [m], roll, pitch, yaw [rad]."""

MAX_MAGNITUDE = 1e9
"""Largest magnitude of any number in a robot, pose or measurement, in the unit of the file (mm or deg)."""

BoundedFloat = Annotated[float, Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
"""A number in a robot file, finite and of limited magnitude."""

MAX_ROWS = 1000
"""Largest number of rows of a robot."""

_LENGTHS = frozenset(("d", "a", "x", "y", "z"))


def in_file_units(names: Sequence[str], values: Float64[np.ndarray, " names"]) -> dict[str, float]:
    """Return parameters in the units of files by column name, such as `d_mm` for `d` [m], `theta_deg` for `theta`.

    Args:
        names: names of the parameters, from `DH_COLUMNS` or `FRAME_COLUMNS`.
        values: parameters [m or rad].
    """
    return {
        f"{name}_mm" if name in _LENGTHS else f"{name}_deg": float(
            value * 1e3 if name in _LENGTHS else np.rad2deg(value)
        )
        for name, value in zip(names, values, strict=True)
    }


@dataclass(frozen=True)
class Row:
    """One DH and Hayati row `RotZ(theta + q) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`.

    A prismatic joint adds q to d instead; a fixed row has no joint (an end effector, for example).

    Attributes:
        name: unique name in the robot, such as "theta_1".
        type: "revolute", "prismatic" or "fixed".
        direction: +1 or -1, the sign of the controller's values; the joint moves by `direction · q`.
        lower: smallest joint value [rad or m], with the sign of the controller; -inf if there is no limit.
        upper: largest joint value [rad or m].
        urdf_origin: position of the joint's origin in a URDF file, in the frame before the row [m]; the kinematics do
            not depend on it.
    """

    name: str
    type: JointType
    direction: int = 1
    lower: float = -np.inf
    upper: float = np.inf
    urdf_origin: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), compare=False)

    @property
    def file_unit(self) -> str:
        """Unit of the joint values in files: "mm" for a prismatic joint, otherwise "deg"."""
        return "mm" if self.type == "prismatic" else "deg"

    def in_file_unit(self, value: float) -> float:
        """Return a joint value [rad or m] in the unit of files."""
        return float(value * 1e3 if self.type == "prismatic" else np.rad2deg(value))

    def from_file_unit(self, value: float) -> float:
        """Return a joint value [rad or m] from its value in the unit of files."""
        return float(value / 1e3 if self.type == "prismatic" else np.deg2rad(value))
