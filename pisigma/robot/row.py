"""What a serial robot is written down as: DH + Hayati rows with their joints, base and tool, in SI units."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

JointType = Literal["revolute", "prismatic", "fixed"]

DH_COLUMNS = ("theta", "d", "a", "alpha", "beta")
"""Order of the parameters of a row, everywhere; theta, alpha, beta [rad], d, a [m]."""

FRAME_COLUMNS = ("x", "y", "z", "roll", "pitch", "yaw")
"""Order of the parameters of base and tool, everywhere; x, y, z [m], roll, pitch, yaw [rad]."""

LARGEST = 1e9
"""[mm, deg, or as a file states it] No robot, pose or measurement has a larger value."""

Bounded = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""A number of a robot file."""

MOST_ROWS = 1000
"""Of a robot."""

_LENGTHS = frozenset(("d", "a", "x", "y", "z"))


def in_file_units(names: Sequence[str], values: Float64[np.ndarray, " names"]) -> dict[str, float]:
    """Parameters in the units of files, by their columns there: `d` [m] as `d_mm`, `theta` [rad] as `theta_deg`.

    Args:
        names: of `DH_COLUMNS` or `FRAME_COLUMNS`.
        values: the parameters [m or rad].
    """
    return {
        f"{name}_mm" if name in _LENGTHS else f"{name}_deg": float(
            value * 1e3 if name in _LENGTHS else np.rad2deg(value)
        )
        for name, value in zip(names, values, strict=True)
    }


@dataclass(frozen=True)
class Row:
    """One DH + Hayati row `RotZ(theta + q) · Trans(a, 0, d) · RotX(alpha) · RotY(beta)`.

    A prismatic joint adds q to d instead; a fixed row has no joint (an end effector, for example).

    Attributes:
        name: unique in the robot, such as "theta_1".
        type: "revolute", "prismatic" or "fixed".
        direction: +1 or -1: how the controller counts; the joint moves by `direction · q`.
        lower: smallest joint value [rad or m], as the controller counts; -inf where there is no limit.
        upper: largest joint value [rad or m].
        drawn_at: where the joint is drawn, in the frame before the row [m], which a URDF file says; the motion does not
            depend on it.
    """

    name: str
    type: JointType
    direction: int = 1
    lower: float = -np.inf
    upper: float = np.inf
    drawn_at: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), compare=False)

    @property
    def file_unit(self) -> str:
        """Unit of its joint values in files: "deg", or "mm" of a joint that slides."""
        return "mm" if self.type == "prismatic" else "deg"

    def in_file_unit(self, value: float) -> float:
        """A joint value [rad or m] in the unit of files."""
        return float(value * 1e3 if self.type == "prismatic" else np.rad2deg(value))

    def from_file_unit(self, value: float) -> float:
        """A joint value in the unit of files as [rad or m]."""
        return float(value / 1e3 if self.type == "prismatic" else np.deg2rad(value))
