"""Orientations of wanted poses: a home orientation and a random spread about it."""

import torch
from jaxtyping import Float64
from pydantic import Field, field_validator, model_validator
from torch import Tensor

from pisigma.se3 import rotation_from_rpy
from pisigma.yaml_file import Section

Triple = tuple[float, float, float]


class OrientationSection(Section):
    """`R = R_home · RotZ(roll) · RotY(pitch) · RotX(yaw)`, each angle uniform in +-spread.

    Source: Jeong, Kim and Kwak 1998, section 4.2.1 and appendix B.

    Attributes:
        home_rpy_deg: R_home as roll, pitch, yaw [deg].
        home_rotation: R_home as three rows, instead.
        spread_deg: half the range of roll, pitch and yaw [deg]; 0 for the home orientation everywhere.
    """

    home_rpy_deg: Triple | None = None
    home_rotation: tuple[Triple, Triple, Triple] | None = None
    spread_deg: float = Field(default=0.0, ge=0, le=180)

    @field_validator("home_rotation")
    @classmethod
    def _is_rotation(cls, rows: tuple[Triple, Triple, Triple] | None) -> tuple[Triple, Triple, Triple] | None:
        if rows is not None:
            R = torch.tensor(rows, dtype=torch.float64)
            deviation = (R.mT @ R - torch.eye(3, dtype=torch.float64)).abs().max()
            if deviation > 1e-9 or torch.linalg.det(R) < 0:
                raise ValueError("three orthonormal, right-handed rows of a rotation are wanted")
        return rows

    @model_validator(mode="after")
    def _one_home(self) -> "OrientationSection":
        if self.home_rpy_deg is not None and self.home_rotation is not None:
            raise ValueError("state home_rpy_deg or home_rotation, not both")
        return self

    def rotations(self, count: int, generator: torch.Generator | None) -> Float64[Tensor, "count 3 3"]:
        """One orientation per pose.

        Args:
            count: how many.
            generator: where roll, pitch, yaw are drawn from, as one (count, 3) block; not used without a
                spread.
        """
        if self.home_rotation is not None:
            home = torch.tensor(self.home_rotation, dtype=torch.float64)
        else:
            home = rotation_from_rpy(
                torch.deg2rad(torch.tensor(self.home_rpy_deg or (0.0,) * 3, dtype=torch.float64))
            )
        if not self.spread_deg:
            return home.expand(count, 3, 3).clone()
        draws = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
        return home @ rotation_from_rpy(torch.deg2rad(self.spread_deg * draws))
