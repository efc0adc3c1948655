"""Touches: one coordinate of the tip in its frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.sensors.sensor import AbstractSensor, OwnUnknowns


@dataclass(frozen=True, eq=False)
class TouchSensor(AbstractSensor):
    """A tip that touches a face: `axis · p_tool = coordinate` (Lim et al., eqs 35 to 37).

    Attributes:
        axis: unit vector of the touched coordinate, as seen from the base's anchor.
        measured: the coordinate along it [m].
        seen: whether a row has one.
        sigma: standard deviation of every row [m], or None.
    """

    name = "touch"
    unit = "m"
    components = 1
    turning = False
    axis: Float64[Tensor, "3 rows"]
    measured: Float64[Tensor, " rows"]
    seen: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    def residual(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "components poses"]:
        """Measured minus predicted coordinate [m]."""
        return (self.measured[rows] - (self.axis[:, rows] * motion.position).sum(0))[None]

    def select(self, rows: Int64[Tensor, " chosen"]) -> "TouchSensor":
        """Some of the rows."""
        sigma = None if self.sigma is None else self.sigma[rows]
        return TouchSensor(self.axis[:, rows], self.measured[rows], self.seen[rows], sigma)

    def derivative(
        self, motion: ToolMotion, own: OwnUnknowns, rows: slice
    ) -> Float[Tensor, "parameters components poses"]:
        """The tool's shift along the axis."""
        return along(self.axis[:, rows], motion.derivative)


def along(
    axis: Float[Tensor, "3 poses"], derivative: Float[Tensor, "parameters six poses"]
) -> Float[Tensor, "parameters 1 poses"]:
    """The part of every parameter's shift of the tool that is along an axis."""
    found = derivative[:, 0] * axis[0]
    for k in (1, 2):
        found = torch.addcmul(found, derivative[:, k], axis[k])
    return found[:, None]
