"""Trackers: measured positions of a target, and measured orientations of the tool."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from pisigma.measurement.sensors.sensor import AbstractSensor, Derivative, SensorRows, Unknowns, Values
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion
from pisigma.robot.se3 import rotation_vector

NEARLY_OPPOSITE = -0.99
"""Cosine of the turn below which its axis comes from the symmetric part."""


@dataclass(frozen=True, eq=False)
class PositionSensor(AbstractSensor):
    """A tracker that measures a reflector: three coordinates in its frame.

    Attributes:
        measured: positions [m].
        present: whether a row has one.
        sigma: standard deviation of a coordinate [m] of every row, or None.
    """

    name = "position"
    unit = "m"
    components = 3
    measured: Float64[Tensor, "3 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "PositionSensor | None":
        """Gather the positions, as seen from the bases' anchors."""
        data = rows.measurements
        present = (data.measured("position") | data.measured("pose")) & ~rows.by_corners
        if data.position is None or not bool(present.any()):
            return None
        R, p = rows.bases[:, :3, :3], rows.bases[:, :3, 3]
        position = ((data.position - p)[:, None] @ R)[:, 0]
        return cls(torch.where(present, position.t(), 0.0).contiguous(), present, rows.sigma(present))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return measured minus predicted positions [m]."""
        return self.measured[:, rows] - motion.position

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the tool's shift."""
        return motion.derivative[:, :3]


@dataclass(frozen=True, eq=False)
class RotationSensor(AbstractSensor):
    """The orientation that a 6D tracker measures, as a rotation vector from the predicted to the measured one.

    Attributes:
        measured: rotations, the row index last.
        present: whether a row has one.
        sigma: standard deviation of an angle [rad] of every row, or None.
    """

    name = "rotation"
    unit = "rad"
    components = 3
    turning = True
    measured: Float64[Tensor, "3 3 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None

    @classmethod
    def build(cls, rows: SensorRows) -> "RotationSensor | None":
        """Gather the orientations, as seen from the bases' anchors and freed of the tools' anchors."""
        data = rows.measurements
        present = (data.measured("rotation") | data.measured("pose")) & ~rows.by_corners
        if data.rotation is None or not bool(present.any()):
            return None
        rotation = rows.bases[:, :3, :3].mT @ data.rotation @ rows.tools.mT
        eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
        rotation = torch.where(present[:, None, None], rotation, eye).permute(1, 2, 0).contiguous()
        return cls(rotation, present, rows.sigma(present, "rad"))

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the rotation vectors of measured · predicted^T [rad]."""
        return rotation_difference(self.measured[..., rows], motion.rotation)

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the tool's turn.

        The residual r falls by `J_r(r)^-1 turn` rather than by the turn; as `J_r^-T r = r`, the cost's
        gradient is exact with the turn itself, and the Gauss-Newton matrix is right to second order in r.
        """
        return motion.derivative[:, 3:]


def rotation_difference(
    measured: Float[Tensor, "3 3 rows"], predicted: Float[Tensor, "3 3 rows"]
) -> Float[Tensor, "3 rows"]:
    """Return the rotation vectors of measured · predicted^T [rad], as `rotation_vector` has them.

    Of the product R only its trace and `R - R^T` are worked out, which determine every turn that is not nearly half
    a one: with m and p the columns of the rotations, the vector part of `R - R^T` is `Σ p × m`.
    """
    twice_sine_axis = torch.linalg.cross(predicted, measured, dim=0).sum(1)
    cosine = ((measured * predicted).sum((0, 1)) - 1) / 2
    if bool((cosine < NEARLY_OPPOSITE).any()):
        return rotation_vector(torch.einsum("ijn,kjn->nik", measured, predicted)).t()
    sine_square = twice_sine_axis.square().sum(0) / 4
    sine = sine_square.sqrt()
    # near no turn the quotient is 0 / 0, so its series stands in
    factor = torch.where(sine_square > 1e-8, torch.atan2(sine, cosine) / (2 * sine), 0.5 + sine_square / 12)
    turn: Tensor = twice_sine_axis * factor
    return turn
