"""Cameras: the pose that the corners of a board in one image give, weighted by its whole covariance."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor

from pisigma.kinematics.parameter_jacobian import ToolMotion
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import ReadingColumn, Readings, RowFault, SensorReadings
from pisigma.sensors.pose import rotation_difference
from pisigma.sensors.sensor import AbstractSensor, Derivative, SensorRows, Unknowns, Values

NOISE_COLUMN, WEIGHT_COLUMN = "corner_noise", "corner_weight"
WEIGHTS = 21
"""Numbers of a lower triangular matrix of six rows."""


def weight_text(weight: Float64[np.ndarray, "6 6"]) -> str:
    """Return what a cell of the weights' column holds: the lower triangle, row by row, with blanks between."""
    return " ".join(f"{value:.17g}" for value in weight[np.tril_indices(6)])


def _weights(text: str) -> list[float]:
    """The numbers in a cell of the weights' column; none where it is empty or at fault."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return []
    return numbers if len(numbers) == WEIGHTS and all(map(math.isfinite, numbers)) else []


def _row_faults(readings: Readings) -> Iterator[RowFault]:
    """Find rows with noise or weights alone, and noise or weights that are none."""
    noise = np.asarray(readings[NOISE_COLUMN])
    texts = readings[WEIGHT_COLUMN]
    weighted = np.array([bool(_weights(str(text))) for text in texts])
    yield (
        np.isfinite(noise) != weighted,
        lambda row: f"a noise and {WEIGHTS} weights with blanks between were wanted, got '{texts[row]}'",
    )
    yield noise <= 0, lambda row: f"a positive noise was wanted, got {noise[row] * 1e3:.6g} mm"


@dataclass(frozen=True, eq=False)
class CornerSensor(AbstractSensor):
    """A camera that sees a board: `W · (position; rotation vector)` of measured against predicted poses.

    An image determines some directions of its pose much better than others, and shift and turn together. So the row
    of an image states, beside the pose, a lower triangular W with `W^T W` the inverse covariance of (position [m],
    turn [rad]) in the axes of the row's frame. The covariance is the sum of what the corners leave open and of the
    robot's repeatability: the pose error that all corners of an image share is thereby eliminated in closed form.
    Values are the noise of one corner, as a length at the board, times W times the errors.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations, the row index last.
        weight: noise times W for errors seen from the base's anchor [1, and m/rad].
        present: whether a row has one.
        sigma: None; the noise is estimated.
    """

    name = "corner"
    unit = "m"
    components = 6
    turning = True
    readings = SensorReadings(
        "corner",
        (ReadingColumn(NOISE_COLUMN, ("mm",)), ReadingColumn(WEIGHT_COLUMN, is_text=True)),
        is_length=False,
        row_faults=_row_faults,
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
        weight = _scaled_weights(data)
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


def position_deviations(measurements: Measurements) -> Float64[Tensor, "rows 3"]:
    """Return standard deviations of positions [1: per noise of a corner], NaN in rows that no image gave."""
    weight = _scaled_weights(measurements)
    by_image = measurements.measured("corner")
    eye = torch.eye(6).to(weight)
    spread = torch.linalg.inv(torch.where(by_image[:, None, None], weight, eye))
    return torch.where(by_image[:, None], spread[:, :3].norm(dim=-1), torch.nan)


def _scaled_weights(measurements: Measurements) -> Float64[Tensor, "rows 6 6"]:
    """Noise times W of every row, 0 in rows that no image gave."""
    scaled = measurements.q.new_zeros(measurements.rows, 6, 6)
    noise, texts = (measurements.readings.get(name) for name in (NOISE_COLUMN, WEIGHT_COLUMN))
    if isinstance(noise, Tensor) and isinstance(texts, tuple):
        row, column = torch.tril_indices(6, 6).to(scaled.device)
        triangles = scaled.new_tensor([_weights(text) or [0.0] * WEIGHTS for text in texts])
        scaled[:, row, column] = torch.nan_to_num(noise)[:, None] * triangles
    return scaled


def as_poses(measurements: Measurements) -> Measurements:
    """Return rows of images as plain poses, without the weights of their corners."""
    others = {
        name: values
        for name, values in measurements.readings.items()
        if name not in (NOISE_COLUMN, WEIGHT_COLUMN)
    }
    return replace(measurements, readings=others)
