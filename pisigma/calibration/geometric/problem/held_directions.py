"""Directions of the free parameters that a search does not change, because the rows do not determine them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

LARGEST_DEVIATION = 1e3
"""Standard deviation [mm or mrad] in the covariance of directions on which the rows contain no information."""


@dataclass(frozen=True, eq=False)
class HeldDirections:
    """Directions along which a search does not move.

    Attributes:
        directions: the directions, orthonormal in units of 1 mm and 1 mrad (`CalibrationProblem.step_scale`).
        sigma: standard deviation of the values along the directions in these units; infinite if the rows contain
            no information on them.
    """

    directions: Float64[Tensor, "active held"]
    sigma: Float64[Tensor, " held"]

    def restrict(
        self,
        normal: Float64[Tensor, "active active"],
        descent: Float64[Tensor, " active"],
        scale: Float64[Tensor, " active"],
    ) -> tuple[Float64[Tensor, "active active"], Float64[Tensor, " active"]]:
        """Return normal equations whose step has no component along the directions.

        With the directions V and `P = I - V V^T`, they are `P normal P + c V V^T` and `P descent` in units of `scale`.
        The constant c, the information on the best determined parameter, only keeps the matrix regular.

        Args:
            normal: matrix of the normal equations [1/m² or 1/rad²].
            descent: their right-hand side [1/m or 1/rad].
            scale: size of 1 mm or 1 mrad for every parameter.
        """
        V, units = self.directions.to(normal), scale * scale[:, None]
        P = torch.eye(len(V)).to(normal) - V @ V.t()
        scaled = normal * units
        restricted = P @ scaled @ P + scaled.diagonal().max() * (V @ V.t())
        return restricted / units, (P @ (scale * descent)) / scale

    def covariance_root(self, scale: Float64[Tensor, " active"]) -> Float64[Tensor, "active held"]:
        """Return a root of the covariance of the held values [m or rad]; see `restrict` for `scale`."""
        root: Tensor = scale[:, None] * self.directions.to(scale) * self.sigma.clamp(max=LARGEST_DEVIATION)
        return root
