"""Noise of sensors, and repeatability of a robot."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.files.yaml_file import Section, Seed
from pisigma.robot.se3 import rotation_from_vector, transform


class MeasurementNoise(Section):
    """Normally distributed noise of every measured coordinate and about every axis.

    `p_measured = p + s_p · n_p` and `R_measured = Exp(s_r · n_r) · R` where n_p and n_r are three standard normal
    numbers each and Exp is the rotation of a rotation vector, in the frame of measurement. From one generator with
    `seed`, (rows, 3) numbers are drawn for the positions, then the same number for the orientations.

    Source: Hollerbach, Khalil and Gautier, "Model Identification", Springer Handbook of Robotics, chapter
    6 (independent, zero-mean measurement noise).

    Attributes:
        position_mm: standard deviation per axis [mm].
        orientation_deg: standard deviation per axis [deg].
        seed: random seed.
    """

    position_mm: float = Field(default=0.0, ge=0)
    orientation_deg: float = Field(default=0.0, ge=0)
    seed: Seed

    @property
    def sigma_position(self) -> float:
        """Standard deviation of a coordinate [m]."""
        return self.position_mm / 1e3

    @property
    def sigma_rotation(self) -> float:
        """Standard deviation of a rotation about an axis [rad]."""
        return float(torch.deg2rad(torch.tensor(self.orientation_deg, dtype=torch.float64)))

    def apply(self, T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, "rows 4 4"]:
        """Return measured poses: true poses with noise; every call returns the same poses.

        Args:
            T: true poses in the frame of measurement.
        """
        generator = torch.Generator().manual_seed(self.seed)
        draws = torch.randn(2, len(T), 3, generator=generator, dtype=torch.float64).to(T.device)
        position = T[..., :3, 3] + self.sigma_position * draws[0]
        rotation = rotation_from_vector(self.sigma_rotation * draws[1]) @ T[..., :3, :3]
        return transform(rotation, position)


@dataclass(frozen=True, eq=False)
class NoiseDraws:
    """Random deviations of sensor and robot, one row per measurement.

    Attributes:
        sensor: deviations of the sensor [m]; sensors with a single value use the first column.
        robot: deviations of the tool point from the commanded point, in the base frame [m].
    """

    sensor: Float64[Tensor, "rows 3"]
    robot: Float64[Tensor, "rows 3"]


class SensorNoise(Section):
    """Normal deviations, independent from row to row and axis to axis.

    From one generator with `seed`, (rows, 3) standard normal numbers are drawn for the sensor, where a sensor with a
    single value uses the first column, then (rows, 3) for the robot.

    Attributes:
        sensor_mm: standard deviation of a measured length, or of every axis of a ball in its socket [mm].
        repeatability_mm: standard deviation of the tool point per axis of the base frame, between repeats of the same
            joint values [mm].
        seed: random seed.
    """

    sensor_mm: float = Field(default=0.0, ge=0)
    repeatability_mm: float = Field(default=0.0, ge=0)
    seed: Seed

    def draw(self, rows: int) -> NoiseDraws:
        """Return random deviations of the given number of rows; every call returns the same values."""
        generator = torch.Generator().manual_seed(self.seed)
        draws = torch.randn(2, rows, 3, generator=generator, dtype=torch.float64)
        return NoiseDraws(self.sensor_mm / 1e3 * draws[0], self.repeatability_mm / 1e3 * draws[1])

    def sigma(self, points: int = 1) -> float:
        """Return the standard deviation [m] of a length that depends on the given number of tool points."""
        return float((self.sensor_mm**2 + points * self.repeatability_mm**2) ** 0.5) / 1e3


def draw_noise(noise: SensorNoise | None, rows: int) -> NoiseDraws:
    """Return random deviations of the given number of rows; 0 if there is no noise."""
    return (noise or SensorNoise(seed=0)).draw(rows)


def row_sigma(noise: SensorNoise | None, rows: int, points: int = 1) -> Float64[Tensor, " rows"] | None:
    """Return the standard deviation of the noise of every row [m]; None if there is no noise."""
    sigma = 0.0 if noise is None else noise.sigma(points)
    return torch.full((rows,), sigma, dtype=torch.float64) if sigma else None
