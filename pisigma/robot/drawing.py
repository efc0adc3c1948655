"""What a file says of a robot, before it is checked as a whole."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from pisigma.robot.coupling import Coupling
from pisigma.robot.row import Row


class Drawing(NamedTuple):
    """What a file says of a robot, not yet checked as a whole; see `Robot`, which has the same attributes.

    Attributes:
        name: short name, as in the catalogue.
        maker: who builds it.
        source: where the figures come from.
        rows: joints and fixed rows, from the base to the tool.
        dh: `(rows, 5)`, columns as `DH_COLUMNS`.
        base: as `FRAME_COLUMNS`.
        tool: as `FRAME_COLUMNS`.
        coupling: how the joints follow the controller's values; None where they are the same.
        urdf: the content of the URDF file that it is; None where it is none.
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
