"""Fields of a robot file before they are checked for consistency."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from pisigma.robot.coupling import Coupling
from pisigma.robot.row import Row


class RobotFields(NamedTuple):
    """Contents of a robot file, not yet checked as a whole; see `Robot`, which has the same attributes.

    Attributes:
        name: short name, as in the catalogue.
        maker: manufacturer.
        source: origin of the parameter values.
        rows: joints and fixed rows, from the base to the tool.
        dh: `(rows, 5)`, columns as `DH_COLUMNS`.
        base: frame in the order of `FRAME_COLUMNS`.
        tool: frame in the order of `FRAME_COLUMNS`.
        coupling: relation of joint values and controller values; None if they are equal.
        urdf: content of the file if it is a URDF file, otherwise None.
    """

    name: str
    maker: str
    source: str
    rows: tuple[Row, ...]
    dh: Float64[np.ndarray, " rows 5"]
    base: Float64[np.ndarray, " 6"]
    tool: Float64[np.ndarray, " 6"]
    coupling: Coupling | None = None
    urdf: bytes | None = None
