"""Stated or random errors of the geometry of links, base and tool."""

from typing import Literal

import numpy as np
import torch
from jaxtyping import Float64
from pydantic import Field

from pisigma.files.yaml_file import Seed
from pisigma.robot.description import Robot
from pisigma.robot.robot_file import FrameSection, ParameterSection
from pisigma.simulation.errors.source import AbstractGeometrySource, GeometryChange, row_index


class GeometricDeviation(AbstractGeometrySource):
    """Stated errors of geometric parameters.

    `dh_true = dh_nominal + rows`, `base_true = base_nominal + base`, `tool_true = tool_nominal + tool`, for every
    parameter of `A_i = RotZ(theta) Trans(a, 0, d) RotX(alpha) RotY(beta)` and of base and tool
    `Trans(x, y, z) RotZ(roll) RotY(pitch) RotX(yaw)`.

    Source: Hayati and Mirmirani, "Improving the absolute positioning accuracy of robot manipulators",
    Journal of Robotic Systems 2(4), 1985, 397-413, whose extra rotation beta keeps near-parallel axes
    well behaved.

    Attributes:
        kind: "geometric".
        rows: errors of theta, alpha, beta [deg] and d, a [mm], by row name.
        base: errors of x, y, z [mm], roll, pitch, yaw [deg] of the base.
        tool: errors of x, y, z [mm], roll, pitch, yaw [deg] of the tool.
    """

    kind: Literal["geometric"]
    rows: dict[str, ParameterSection] = Field(default_factory=dict)
    base: FrameSection = FrameSection()
    tool: FrameSection = FrameSection()

    def parameter_errors(self, robot: Robot, place_in_recipe: str) -> GeometryChange:
        """Return the stated errors [rad or m]; see `AbstractGeometrySource.parameter_errors`."""
        dh = np.zeros_like(robot.dh)
        for name, error in self.rows.items():
            dh[row_index(robot, name, place_in_recipe)] = error.to_si()
        return GeometryChange(dh, self.base.to_si(), self.tool.to_si())


_LENGTH_IN_ROW = np.array([False, True, True, False, False])
_LENGTH_IN_FRAME = np.array([True, True, True, False, False, False])


class RandomGeometricDeviation(AbstractGeometrySource):
    """Independent random errors of all geometric parameters.

    `p_true = p_nominal + s · u`, with s the size for lengths or angles and u uniform in [-1, 1), or standard normal.
    From one generator with `seed`, (rows, 5) values are drawn for the DH rows (theta, d, a, alpha, beta), then 6 for
    the base and 6 for the tool, even for sizes of 0, so that a size does not change the errors of other parameters.

    Source: the parameters are those of Hayati and Mirmirani, Journal of Robotic Systems 2(4), 1985,
    397-413; random errors on all of them are the usual way to test an identification, for example in
    Hollerbach, Khalil and Gautier, "Model Identification", Springer Handbook of Robotics, chapter 6.

    Attributes:
        kind: "geometric_random".
        distribution: "uniform" (sizes are bounds) or "normal" (sizes are standard deviations).
        seed: random seed.
        length_mm: size for d and a [mm].
        angle_deg: size for theta, alpha and beta [deg].
        base_length_mm: size for x, y, z of the base [mm].
        base_angle_deg: size for roll, pitch, yaw of the base [deg].
        tool_length_mm: size for x, y, z of the tool [mm].
        tool_angle_deg: size for roll, pitch, yaw of the tool [deg].
    """

    kind: Literal["geometric_random"]
    distribution: Literal["uniform", "normal"]
    seed: Seed
    length_mm: float = Field(ge=0)
    angle_deg: float = Field(ge=0)
    base_length_mm: float = Field(default=0.0, ge=0)
    base_angle_deg: float = Field(default=0.0, ge=0)
    tool_length_mm: float = Field(default=0.0, ge=0)
    tool_angle_deg: float = Field(default=0.0, ge=0)

    def parameter_errors(self, robot: Robot, place_in_recipe: str) -> GeometryChange:
        """Return the random errors [rad or m], identical for every call; see `AbstractGeometrySource`."""
        generator = torch.Generator().manual_seed(self.seed)
        dh = self._draw(generator, len(robot.rows), 5)
        base, tool = self._draw(generator, 6), self._draw(generator, 6)
        return GeometryChange(
            dh * _sizes(_LENGTH_IN_ROW, self.length_mm, self.angle_deg),
            base * _sizes(_LENGTH_IN_FRAME, self.base_length_mm, self.base_angle_deg),
            tool * _sizes(_LENGTH_IN_FRAME, self.tool_length_mm, self.tool_angle_deg),
        )

    def _draw(self, generator: torch.Generator, *shape: int) -> Float64[np.ndarray, "..."]:
        if self.distribution == "normal":
            return torch.randn(*shape, generator=generator, dtype=torch.float64).numpy()
        return (2 * torch.rand(*shape, generator=generator, dtype=torch.float64) - 1).numpy()


def _sizes(is_length: np.ndarray, length_mm: float, angle_deg: float) -> Float64[np.ndarray, " columns"]:
    return np.where(is_length, length_mm / 1e3, np.deg2rad(angle_deg))
