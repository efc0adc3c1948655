"""Cameras: the pose that the corners of a board in one image give, weighted by its whole covariance."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import ReadingColumn, Readings, RowFault, SensorReadings
from pisigma.measurement.sensors.intrinsics import (
    CAMERA_COLUMN,
    COLUMNS,
    INTRINSICS_COLUMN,
    NOISE_COLUMN,
    NUMBERS,
    SCALE_COLUMN,
    SIZE,
    ImageIntrinsics,
    boards,
    cameras,
    numbers_in,
    texts_of,
)
from pisigma.measurement.sensors.pose import rotation_difference
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    Derivative,
    SensorRows,
    UnknownDerivative,
    Unknowns,
    Values,
    names_of,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion
from pisigma.robot.se3 import rotation_from_vector

WEIGHT_COLUMN = "corner_weight"
WEIGHTS = 21
"""Numbers of a lower triangular matrix of six rows."""


def weight_text(weight: Float64[np.ndarray, "6 6"]) -> str:
    """Return what a cell of the weights' column holds: the lower triangle, row by row, with blanks between."""
    return " ".join(f"{value:.17g}" for value in weight[np.tril_indices(6)])


def _row_faults(readings: Readings) -> Iterator[RowFault]:
    """Find rows with noise or weights alone, and noise or weights that are none."""
    noise = np.asarray(readings[NOISE_COLUMN])
    texts = readings[WEIGHT_COLUMN]
    weighted = np.array([bool(numbers_in(str(text), WEIGHTS)) for text in texts])
    yield (
        np.isfinite(noise) != weighted,
        lambda row: f"a noise and {WEIGHTS} weights with blanks between were wanted, got '{texts[row]}'",
    )
    yield noise <= 0, lambda row: f"a positive noise was wanted, got {noise[row] * 1e3:.6g} mm"
    for name, count in ((INTRINSICS_COLUMN, SIZE), (SCALE_COLUMN, 1)):
        stated = [str(text) for text in readings[name]]
        wrong = np.array([bool(text) and not numbers_in(text, count) for text in stated])
        yield (
            wrong,
            lambda row, name=name, count=count, stated=stated: (  # type: ignore[misc]
                f"{name}: {count} numbers with blanks between were wanted, got '{stated[row][:40]}'"
            ),
        )


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
        camera: index of the camera among those whose intrinsics are identified, -1 where a row has none.
        at: the intrinsics that the poses were solved with.
        by_intrinsics: derivative of the weighted measured pose by the intrinsics.
        board: index of the board, -1 where a row has none.
        by_scale: derivative of the weighted measured pose by the scale of the board [m].
        sigma: None; the noise is estimated.
    """

    name = "corner"
    unit = "m"
    components = 6
    turning = True
    readings = SensorReadings(
        "corner",
        (ReadingColumn(NOISE_COLUMN, ("mm",)), ReadingColumn(WEIGHT_COLUMN, is_text=True), *COLUMNS),
        is_length=False,
        row_faults=_row_faults,
    )
    position: Float64[Tensor, "3 rows"]
    rotation: Float64[Tensor, "3 3 rows"]
    weight: Float64[Tensor, "6 6 rows"]
    present: Bool[Tensor, " rows"]
    camera: Int64[Tensor, " rows"]
    at: Float64[Tensor, "9 rows"]
    by_intrinsics: Float64[Tensor, "6 9 rows"]
    board: Int64[Tensor, " rows"]
    by_scale: Float64[Tensor, "6 rows"]
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
        images = ImageIntrinsics.of(texts_of(data, INTRINSICS_COLUMN))
        of_camera, of_board = cameras(data), boards(data)
        at, by = (torch.from_numpy(values).to(R) for values in (images.at, images.by))
        by_scale = torch.where(present, torch.einsum("nij,nj->in", weight[..., :3], data.position), 0.0)
        return cls(
            position,
            rotation.permute(1, 2, 0).contiguous(),
            turned.permute(1, 2, 0),
            present,
            camera=rows.numbers(of_camera, names_of(of_camera)),
            at=at.t(),
            by_intrinsics=(weight @ by).permute(1, 2, 0),
            board=rows.numbers(of_board, names_of(of_board)),
            by_scale=by_scale,
        )

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the weighted errors of the poses [m]."""
        off = torch.cat([self.position[:, rows] - motion.position, self._turned(motion, rows)])
        residual: Tensor = torch.einsum("ijn,jn->in", self.weight[..., rows], off)
        if "camera" in unknowns:
            moved = unknowns["camera"][:, self.camera[rows]] - self.at[:, rows]
            residual += torch.einsum("ijn,jn->in", self.by_intrinsics[..., rows], moved)
        if "board" in unknowns:
            residual += self.by_scale[:, rows] * unknowns["board"][:, self.board[rows]]
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

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return minus the change of the measured pose with the intrinsics and the scale of the board."""
        of_camera = UnknownDerivative(
            "camera", self.camera[rows], -self.by_intrinsics[..., rows].transpose(0, 1)
        )
        of_board = UnknownDerivative("board", self.board[rows], -self.by_scale[None, :, rows])
        return tuple(one for one in (of_camera, of_board) if one.group in unknowns)

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
        triangles = scaled.new_tensor([numbers_in(text, WEIGHTS) or [0.0] * WEIGHTS for text in texts])
        scaled[:, row, column] = torch.nan_to_num(noise)[:, None] * triangles
    return scaled


def as_poses(
    measurements: Measurements, unknowns: Mapping[str, Mapping[str, Float64[np.ndarray, " columns"]]]
) -> Measurements:
    """Return rows of images as plain poses, without the weights of their corners.

    Args:
        measurements: with rows of images or without.
        unknowns: by group and owner, what was identified; images of a camera or a board that is not here are as they
            were read.
    """
    names = (NOISE_COLUMN, WEIGHT_COLUMN, CAMERA_COLUMN, INTRINSICS_COLUMN, SCALE_COLUMN)
    others = {name: values for name, values in measurements.readings.items() if name not in names}
    position, rotation = measurements.position, measurements.rotation
    if position is None or rotation is None or CAMERA_COLUMN not in measurements.readings:
        return replace(measurements, readings=others)
    images = ImageIntrinsics.of(texts_of(measurements, INTRINSICS_COLUMN))
    moved = np.zeros((measurements.rows, NUMBERS))
    scale = np.ones(measurements.rows)
    for row, camera in enumerate(cameras(measurements) or ()):
        moved[row] = unknowns.get("camera", {}).get(camera, images.at[row]) - images.at[row]
    for row, board in enumerate(boards(measurements) or ()):
        scale[row] += float(unknowns.get("board", {}).get(board, np.zeros(1))[0])
    change = torch.from_numpy(np.einsum("nij,nj->ni", images.by, moved)).to(position)
    return replace(
        measurements,
        position=(position + change[:, :3]) * torch.from_numpy(scale).to(position)[:, None],
        rotation=rotation_from_vector(change[:, 3:]) @ rotation,
        readings=others,
    )


def with_held_camera(measurements: Measurements, length: float, angle: float) -> Measurements:
    """Return rows of images as with certain intrinsics and board, but with more noise of their poses.

    Args:
        measurements: the rows.
        length: standard deviation of each coordinate that is added [m].
        angle: and of a turn about each axis [rad].
    """
    texts = measurements.readings.get(WEIGHT_COLUMN)
    if not isinstance(texts, tuple):
        return measurements
    more = np.diag([length**2] * 3 + [angle**2] * 3)
    weights = []
    for text in texts:
        numbers = numbers_in(text, WEIGHTS)
        if numbers:
            W = np.zeros((6, 6))
            W[np.tril_indices(6)] = numbers
            lower = np.linalg.cholesky(np.linalg.inv(W.T @ W) + more)
            text = weight_text(np.linalg.inv(lower))
        weights.append(text)
    others = {
        name: values
        for name, values in measurements.readings.items()
        if name not in (INTRINSICS_COLUMN, SCALE_COLUMN)
    }
    return replace(measurements, readings={**others, WEIGHT_COLUMN: tuple(weights)})
