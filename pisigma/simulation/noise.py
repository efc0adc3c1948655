"""Noise of the measuring device."""

import torch
from jaxtyping import Float64
from pydantic import Field
from torch import Tensor

from pisigma.se3 import rotation_from_vector, transform
from pisigma.yaml_file import Section


class MeasurementNoise(Section):
    """Normal noise on every measured coordinate and about every axis.

    `p_measured = p + s_p · n_p` and `R_measured = Exp(s_r · n_r) · R` with n_p and n_r three standard normal
    numbers each and Exp the rotation of a rotation vector, in the frame of measurement. From one generator
    with `seed`, (rows, 3) numbers are drawn for the positions, then as many for the orientations.

    Source: Hollerbach, Khalil and Gautier, "Model Identification", Springer Handbook of Robotics, chapter
    6 (independent, zero-mean measurement noise).

    Attributes:
        position_mm: standard deviation per axis [mm].
        orientation_deg: standard deviation per axis [deg].
        seed: of the generator.
    """

    position_mm: float = Field(default=0.0, ge=0)
    orientation_deg: float = Field(default=0.0, ge=0)
    seed: int = Field(ge=0)

    @property
    def sigma_position(self) -> float:
        """Standard deviation of a coordinate [m]."""
        return self.position_mm / 1e3

    @property
    def sigma_rotation(self) -> float:
        """Standard deviation of a rotation about an axis [rad]."""
        return float(torch.deg2rad(torch.tensor(self.orientation_deg, dtype=torch.float64)))

    def apply(self, T: Float64[Tensor, "rows 4 4"]) -> Float64[Tensor, "rows 4 4"]:
        """The poses as they are measured; the same at every call.

        Args:
            T: true poses in the frame of measurement.
        """
        generator = torch.Generator().manual_seed(self.seed)
        draws = torch.randn(2, len(T), 3, generator=generator, dtype=torch.float64).to(T.device)
        position = T[..., :3, 3] + self.sigma_position * draws[0]
        rotation = rotation_from_vector(self.sigma_rotation * draws[1]) @ T[..., :3, :3]
        return transform(rotation, position)
