"""Wrong geometry with every error stated: links, base and tool."""

from typing import Literal

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection
from pisigma.simulation.joint_names import row_index
from pisigma.simulation.errors.source import AbstractGeometrySource, GeometryChange
from pisigma.yaml_file import Section


class RowDeviation(Section):
    """What is added to the parameters of one row. Angles in degrees, lengths in millimetres."""

    theta_deg: float = 0.0
    d_mm: float = 0.0
    a_mm: float = 0.0
    alpha_deg: float = 0.0
    beta_deg: float = 0.0

    def to_si(self) -> Float64[np.ndarray, " 5"]:
        """Give theta [rad], d [m], a [m], alpha [rad], beta [rad]."""
        theta, alpha, beta = np.deg2rad([self.theta_deg, self.alpha_deg, self.beta_deg])
        return np.array([theta, self.d_mm / 1e3, self.a_mm / 1e3, alpha, beta])


class GeometricDeviation(AbstractGeometrySource):
    """Geometric parameters that differ from the drawing.

    `dh_true = dh_nominal + rows`, `base_true = base_nominal + base`, `tool_true = tool_nominal + tool`: every
    parameter of `A_i = RotZ(theta) Trans(a, 0, d) RotX(alpha) RotY(beta)` and of base and tool
    `Trans(x, y, z) RotZ(roll) RotY(pitch) RotX(yaw)` by itself.

    Source: Hayati and Mirmirani, "Improving the absolute positioning accuracy of robot manipulators",
    Journal of Robotic Systems 2(4), 1985, 397-413, whose extra rotation beta keeps near-parallel axes
    well behaved.

    Attributes:
        kind: "geometric".
        rows: by row name, what is added to theta, alpha, beta [deg] and d, a [mm].
        base: what is added to x, y, z [mm], roll, pitch, yaw [deg] of the base.
        tool: the same for the tool.
    """

    kind: Literal["geometric"]
    rows: dict[str, RowDeviation] = Field(default_factory=dict)
    base: FrameSection = FrameSection()
    tool: FrameSection = FrameSection()

    def change(self, robot: Robot, place: str) -> GeometryChange:
        """The stated errors in SI. See `AbstractGeometrySource.change`."""
        dh = np.zeros_like(robot.dh)
        for name, error in self.rows.items():
            dh[row_index(robot, name, place)] = error.to_si()
        return GeometryChange(dh, self.base.to_si(), self.tool.to_si())
