"""Positions and orientations of the tool from trackers, and single coordinates of its tip from touches of a jig."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
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
from pisigma.robot.se3 import rotation_vector

_NEARLY_OPPOSITE = -0.99
"""Cosine of the rotation angle below which the axis is computed from the symmetric part."""


@dataclass(frozen=True, eq=False)
class PositionSensor(AbstractSensor):
    """A tracker that measures a reflector: three coordinates in its frame.

    Attributes:
        measured: measured positions [m].
        present: mask of the rows with a position.
        sigma: standard deviation of a coordinate [m] of every row; None if it is estimated.
    """

    name = "position"
    unit = "m"
    components = 3
    measured: Float64[Tensor, "3 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "PositionSensor | None":
        """Build the sensor from the positions, in the frames of the bases' anchors; None if there are none."""
        data = rows.measurements
        present = (data.is_measured("position") | data.is_measured("pose")) & ~rows.has_corner_poses
        if data.position is None or not bool(present.any()):
            return None
        R, p = rows.base_anchors[:, :3, :3], rows.base_anchors[:, :3, 3]
        position = ((data.position - p)[:, None] @ R)[:, 0]
        return cls(torch.where(present, position.t(), 0.0).contiguous(), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted positions [m]."""
        return self.measured[:, rows] - motion.position

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the positions: the shift of the tool."""
        return motion.derivative[:, :3]


@dataclass(frozen=True, eq=False)
class RotationSensor(AbstractSensor):
    """The orientation from a 6D tracker, as a rotation vector from the predicted to the measured orientation.

    Attributes:
        measured: measured rotations, the row index last.
        present: mask of the rows with an orientation.
        sigma: standard deviation of an angle [rad] of every row; None if it is estimated.
    """

    name = "rotation"
    unit = "rad"
    components = 3
    depends_on_rotation = True
    measured: Float64[Tensor, "3 3 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "RotationSensor | None":
        """Build the sensor from orientations, relative to the anchors of bases and tools; None if there are none."""
        data = rows.measurements
        present = (data.is_measured("rotation") | data.is_measured("pose")) & ~rows.has_corner_poses
        if data.rotation is None or not bool(present.any()):
            return None
        rotation = rows.base_anchors[:, :3, :3].mT @ data.rotation @ rows.tool_rotation_anchors.mT
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        rotation = torch.where(present[:, None, None], rotation, eye).permute(1, 2, 0).contiguous()
        return cls(rotation, present, rows.sigma(present, "rad"))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the rotation vectors of measured · predicted^T [rad]."""
        return rotation_difference(self.measured[..., rows], motion.rotation)

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the orientations: the rotation vectors of the tool's motion.

        The exact derivative of the residual r is `-J_r(r)^-1` times that rotation vector. As `J_r^-T r = r`, the
        gradient of the cost is exact without J_r, and the Gauss-Newton matrix is correct to second order in r.
        """
        return motion.derivative[:, 3:]


def rotation_difference(
    measured: Float[Tensor, "3 3 rows"], predicted: Float[Tensor, "3 3 rows"]
) -> Float[Tensor, "3 rows"]:
    """Return the rotation vectors of measured · predicted^T [rad], equal to those of `rotation_vector`.

    Only the trace of the product R and `R - R^T` are computed, which determine all rotations except those near 180 deg:
    for the columns m and p of the two rotations, the vector part of `R - R^T` is `Σ p × m`.
    """
    twice_sine_axis = torch.linalg.cross(predicted, measured, dim=0).sum(1)
    cosine = ((measured * predicted).sum((0, 1)) - 1) / 2
    if bool((cosine < _NEARLY_OPPOSITE).any()):
        return rotation_vector(torch.einsum("ijn,kjn->nik", measured, predicted)).t()
    # the vector part of R - R^T has the norm 2 sin, the trace is 1 + 2 cos; atan2 of both is accurate near 0 as well
    sine_square = twice_sine_axis.square().sum(0) / 4
    sine = sine_square.sqrt()
    # near 0 the quotient is 0 / 0, so its series is used there
    factor = torch.where(sine_square > 1e-8, torch.atan2(sine, cosine) / (2 * sine), 0.5 + sine_square / 12)
    difference: Tensor = twice_sine_axis * factor
    return difference


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
        axis = rows.name_indices(data.touch_axis, ("x", "y", "z"))
        lines = rows.base_anchors[torch.arange(data.rows, device=axis.device), axis]
        measured = torch.where(present, data.touch - lines[:, 3], 0.0)
        return cls(lines[:, :3].t().contiguous(), measured, present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted coordinates [m]."""
        return (self.measured[rows] - (self.axis[:, rows] * motion.position).sum(0))[None]

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the coordinates: the shift of the tool along the axis."""
        return component_along(self.axis[:, rows], motion.derivative)
