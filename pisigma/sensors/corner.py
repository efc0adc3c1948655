"""Cameras: the pose that the corners of a board in one image give, weighted by its whole covariance."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import ReadingColumn, SensorReadings
from pisigma.sensors.pose import rotation_difference
from pisigma.sensors.sensor import AbstractSensor, Derivative, SensorRows, Unknowns, Values

WEIGHT_COLUMNS = tuple(f"corner_weight_{row}{column}" for row in range(1, 7) for column in range(1, row + 1))
"""Of a lower triangular matrix, row by row."""


@dataclass(frozen=True, eq=False)
class CornerSensor(AbstractSensor):
    """A camera that sees a board: `W · (position; rotation vector)` of measured against predicted poses.

    An image determines some directions of its pose much better than others, and shift and turn together. So the row
    of an image states, beside the pose, a lower triangular W with `W^T W` proportional to the inverse covariance of
    (position [m], turn [rad]) in the axes of the row's frame. The covariance is the sum of what the corners
    leave open and of the robot's repeatability: the pose error that all corners of an image share is thereby
    eliminated in closed form. W is scaled such that the noise is that of one corner as a length at the board.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations, the row index last.
        weight: W for errors seen from the base's anchor [1, and m/rad].
        present: whether a row has one.
        sigma: None; the noise is estimated.
    """

    name = "corner"
    unit = "m"
    components = 6
    turning = True
    readings = SensorReadings(
        "corner", tuple(ReadingColumn(name) for name in WEIGHT_COLUMNS), is_length=False
    )
    position: Float64[Tensor, "3 rows"]
    rotation: Float64[Tensor, "3 3 rows"]
    weight: Float64[Tensor, "6 6 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"] | None = None

    @classmethod
    def build(cls, rows: SensorRows) -> "CornerSensor | None":
        """Gather the poses by corners, as seen from the bases' anchors and freed of the tools' anchors."""
        data, present = rows.measurements, rows.by_corners
        if data.position is None or data.rotation is None or not bool(present.any()):
            return None
        R, p = rows.bases[:, :3, :3], rows.bases[:, :3, 3]
        eye = torch.eye(3).to(R)
        rotation = torch.where(present[:, None, None], R.mT @ data.rotation @ rows.tools.mT, eye)
        position = torch.where(present, ((data.position - p)[:, None] @ R)[:, 0].t(), 0.0)
        weight = R.new_zeros(data.rows, 6, 6)
        row, column = torch.tril_indices(6, 6).to(R.device)
        weight[:, row, column] = torch.stack([rows.readings(name) for name in WEIGHT_COLUMNS], -1)
        turned = (weight.view(-1, 6, 2, 3) @ R[:, None]).view(-1, 6, 6)
        turned = torch.where(present[:, None, None], turned, 0.0)
        return cls(position, rotation.permute(1, 2, 0).contiguous(), turned.permute(1, 2, 0), present)

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the weighted errors of the poses [m]."""
        off = torch.cat([self.position[:, rows] - motion.position, self._turned(motion, rows)])
        residual: Tensor = torch.einsum("ijn,jn->in", self.weight[..., rows], off)
        return residual

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the weighted shift and turn of the tool.

        A turn ω of the predicted pose lowers the rotation vector r by `ω + r × ω / 2 + r × (r × ω) / 12`, the inverse
        right Jacobian of SO(3) to the third order in r (Chirikjian 2012, eq. 10.86).
        """
        r = self._turned(motion, rows)[None].expand(len(motion.derivative), -1, -1)
        turn = motion.derivative[:, 3:]
        once = torch.linalg.cross(r, turn, dim=1)
        turn = turn + once / 2 + torch.linalg.cross(r, once, dim=1) / 12
        shift_and_turn = torch.cat([motion.derivative[:, :3], turn], 1)
        derivative: Tensor = torch.einsum("ijn,pjn->pin", self.weight[..., rows], shift_and_turn)
        return derivative

    def _turned(self, motion: ToolMotion, rows: slice) -> Float[Tensor, "3 poses"]:
        return rotation_difference(self.rotation[..., rows], motion.rotation)


def as_poses(measurements: Measurements) -> Measurements:
    """Return rows of images as plain poses, without the weights of their corners."""
    others = {name: values for name, values in measurements.readings.items() if name not in WEIGHT_COLUMNS}
    return replace(measurements, readings=others)
