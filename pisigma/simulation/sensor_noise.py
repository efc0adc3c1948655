"""Noise of touches, sockets and distances: of the sensor, and of the robot that does not quite repeat."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.yaml_file import Section


@dataclass(frozen=True, eq=False)
class NoiseDraws:
    """Drawn deviations.

    Attributes:
        sensor: of the sensor, as many numbers as it has axes [m].
        robot: by which the tool point misses where the commanded joints would take it, in the base frame [m].
    """

    sensor: Float64[Tensor, "rows 3"]
    robot: Float64[Tensor, "rows 3"]


class SensorNoise(Section):
    """Normal deviations, independent from row to row and axis to axis.

    From one generator with `seed`, (rows, 3) standard normal numbers are drawn for the sensor, of which a
    sensor of one value uses the first column, then (rows, 3) for the robot.

    Attributes:
        sensor_mm: standard deviation of a measured length, or of every axis of a ball in its socket [mm].
        repeatability_mm: standard deviation of the tool point per axis of the base frame, from one approach
            of the same joint values to another [mm].
        seed: of the generator.
    """

    sensor_mm: float = Field(default=0.0, ge=0)
    repeatability_mm: float = Field(default=0.0, ge=0)
    seed: int = Field(ge=0)

    def draw(self, rows: int) -> NoiseDraws:
        """The deviations of so many rows; the same at every call."""
        generator = torch.Generator().manual_seed(self.seed)
        draws = torch.randn(2, rows, 3, generator=generator, dtype=torch.float64)
        return NoiseDraws(self.sensor_mm / 1e3 * draws[0], self.repeatability_mm / 1e3 * draws[1])

    def sigma(self, points: int = 1) -> float:
        """Standard deviation of a measured length in which so many tool points take part [m]."""
        return float((self.sensor_mm**2 + points * self.repeatability_mm**2) ** 0.5) / 1e3


def draw_noise(noise: SensorNoise | None, rows: int) -> NoiseDraws:
    """The deviations of so many rows; all 0 without noise."""
    if noise is not None:
        return noise.draw(rows)
    return NoiseDraws(*torch.zeros(2, rows, 3, dtype=torch.float64))


def row_sigma(noise: SensorNoise | None, rows: int, points: int = 1) -> Float64[Tensor, " rows"] | None:
    """What is told of the noise: its standard deviation in every row [m], None where there is no noise."""
    sigma = 0.0 if noise is None else noise.sigma(points)
    return torch.full((rows,), sigma, dtype=torch.float64) if sigma else None
