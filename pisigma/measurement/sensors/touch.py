"""Touches of a jig, which measure one coordinate of the tip in the frame of the jig."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    Derivative,
    SensorRows,
    Unknowns,
    Values,
    component_along,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion


@dataclass(frozen=True, eq=False)
class TouchSensor(AbstractSensor):
    """A tip that touches a face: `axis · p_tool = coordinate` (Lim et al., eqs 35 to 37).

    Attributes:
        axis: unit vector of the touched coordinate, in the frame of the base's anchor.
        measured: measured coordinate along the axis [m].
        present: mask of the rows with a touch.
        sigma: standard deviation of every row's coordinate [m]; None if it is estimated.
    """

    name = "touch"
    unit = "m"
    components = 1
    axis: Float64[Tensor, "3 rows"]
    measured: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "TouchSensor | None":
        """Build the sensor from the touches; `e · (R p + t) = coordinate` is `(R^T e) · p = coordinate - e · t`."""
        data = rows.measurements
        present = data.is_measured("touch")
        if data.touch is None or not bool(present.any()):
            return None
        axis = rows.numbers(data.touch_axis, ("x", "y", "z"))
        lines = rows.bases[torch.arange(data.rows, device=axis.device), axis]
        measured = torch.where(present, data.touch - lines[:, 3], 0.0)
        return cls(lines[:, :3].t().contiguous(), measured, present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted coordinates [m]."""
        return (self.measured[rows] - (self.axis[:, rows] * motion.position).sum(0))[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the coordinates: the shift of the tool along the axis."""
        return component_along(self.axis[:, rows], motion.derivative)
