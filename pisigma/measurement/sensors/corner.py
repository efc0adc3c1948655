"""Cameras: the pose of a board from the corners in one image, weighted by its full covariance."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.faults import Fault
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
    distinct_names,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion
from pisigma.robot.se3 import rotation_from_vector

WEIGHT_COLUMN = "corner_weight"
WEIGHTS = 21
"""Number of entries of a lower triangular matrix with six rows."""


def weight_text(weight: Float64[np.ndarray, "6 6"]) -> str:
    """Return the weights as the text of a cell: the lower triangle, row by row, separated by spaces."""
    return " ".join(f"{value:.17g}" for value in weight[np.tril_indices(6)])


def _row_faults(readings: Readings) -> Iterator[RowFault]:
    """Return the faults of rows in which noise or weights are missing or invalid."""
    noise = np.asarray(readings[NOISE_COLUMN])
    texts = readings[WEIGHT_COLUMN]
    weighted = np.array([bool(numbers_in(str(text), WEIGHTS)) for text in texts])
    yield (
        np.isfinite(noise) != weighted,
        lambda row: Fault(
            column=WEIGHT_COLUMN,
            expected=f"a value in {NOISE_COLUMN}, and {WEIGHTS} weights separated by spaces",
            value=str(texts[row]),
        ),
    )
    yield (
        noise <= 0,
        lambda row: Fault(
            expected="a noise standard deviation > 0 mm", value=float(f"{noise[row] * 1e3:.6g}")
        ),
    )
    for name, count in ((INTRINSICS_COLUMN, SIZE), (SCALE_COLUMN, 1)):
        stated = [str(text) for text in readings[name]]
        wrong = np.array([bool(text) and not numbers_in(text, count) for text in stated])
        yield (
            wrong,
            lambda row, name=name, count=count, stated=stated: Fault(  # type: ignore[misc]
                column=name, expected=f"{count} numbers separated by spaces", value=stated[row][:40]
            ),
        )


@dataclass(frozen=True, eq=False)
class CornerSensor(AbstractSensor):
    """A camera that sees a board: `W · (position; rotation vector)` of measured relative to predicted poses.

    An image determines some directions of its pose much better than others, and position and rotation are correlated.
    The row of an image therefore states, in addition to the pose, a lower triangular W with `W^T W` the inverse
    covariance of (position [m], rotation vector [rad]) in the axes of the row's frame. The covariance is the sum of
    the covariances of the corners and of the robot's repeatability; the pose error that all corners of an image
    share is thereby eliminated in closed form. Values are the errors multiplied by W and by the noise of one corner,
    expressed as a length at the board.

    Attributes:
        position: measured positions [m].
        rotation: measured rotations, the row index last.
        weight: noise times W for errors in the frame of the base's anchor [1, and m/rad].
        present: mask of the rows from images.
        camera: index of the camera among those whose intrinsics are estimated, -1 in rows without one.
        intrinsics: intrinsics with which the poses were solved.
        intrinsics_jacobian: derivative of the weighted measured pose with respect to the intrinsics.
        board: index of the board, -1 in rows without one.
        scale_derivative: derivative of the weighted measured pose with respect to the scale of the board [m].
        sigma: None; the noise is estimated.
    """

    name = "corner"
    unit = "m"
    components = 6
    depends_on_rotation = True
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
    intrinsics: Float64[Tensor, "9 rows"]
    intrinsics_jacobian: Float64[Tensor, "6 9 rows"]
    board: Int64[Tensor, " rows"]
    scale_derivative: Float64[Tensor, "6 rows"]
    sigma: Float64[Tensor, " rows"] | None = None

    @classmethod
    def build(cls, rows: SensorRows) -> "CornerSensor | None":
        """Build the sensor from the rows of images, with poses relative to the anchors of bases and tools."""
        data, present = rows.measurements, rows.has_corner_poses
        if data.position is None or data.rotation is None or not bool(present.any()):
            return None
        R, p = rows.base_anchors[:, :3, :3], rows.base_anchors[:, :3, 3]
        eye = torch.eye(3).to(R)
        rotation = torch.where(
            present[:, None, None], R.mT @ data.rotation @ rows.tool_rotation_anchors.mT, eye
        )
        position = torch.where(present, ((data.position - p)[:, None] @ R)[:, 0].t(), 0.0)
        weight = _scaled_weights(data)
        # errors are in the frame of the base's anchor, weights in the axes of the row's frame
        rotated = (weight.view(-1, 6, 2, 3) @ R[:, None]).view(-1, 6, 6)
        rotated = torch.where(present[:, None, None], rotated, 0.0)
        images = ImageIntrinsics.from_csv_cells(texts_of(data, INTRINSICS_COLUMN))
        of_camera, of_board = cameras(data), boards(data)
        at, by = (torch.from_numpy(values).to(R) for values in (images.intrinsics, images.pose_jacobian))
        scale_derivative = torch.where(
            present, torch.einsum("nij,nj->in", weight[..., :3], data.position), 0.0
        )
        return cls(
            position,
            rotation.permute(1, 2, 0).contiguous(),
            rotated.permute(1, 2, 0),
            present,
            camera=rows.name_indices(of_camera, distinct_names(of_camera)),
            intrinsics=at.t(),
            intrinsics_jacobian=(weight @ by).permute(1, 2, 0),
            board=rows.name_indices(of_board, distinct_names(of_board)),
            scale_derivative=scale_derivative,
        )

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the weighted errors of the poses [m]."""
        error = torch.cat([self.position[:, rows] - motion.position, self._rotation_error(motion, rows)])
        residual: Tensor = torch.einsum("ijn,jn->in", self.weight[..., rows], error)
        if "camera" in unknowns:
            moved = unknowns["camera"][:, self.camera[rows]] - self.intrinsics[:, rows]
            residual += torch.einsum("ijn,jn->in", self.intrinsics_jacobian[..., rows], moved)
        if "board" in unknowns:
            residual += self.scale_derivative[:, rows] * unknowns["board"][:, self.board[rows]]
        return residual

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return the derivatives of the weighted poses: the weighted shift and rotation of the tool.

        A rotation ω of the predicted pose changes the rotation vector r by `-(ω + r × ω / 2 + r × (r × ω) / 12)`, the
        inverse right Jacobian of SO(3) to third order in r (Chirikjian 2012, eq. 10.86).
        """
        r = self._rotation_error(motion, rows)[None].expand(len(motion.derivative), -1, -1)
        omega = motion.derivative[:, 3:]
        once = torch.linalg.cross(r, omega, dim=1)
        rotation = omega + once / 2 + torch.linalg.cross(r, once, dim=1) / 12
        shift_and_rotation = torch.cat([motion.derivative[:, :3], rotation], 1)
        derivative: Tensor = torch.einsum("ijn,pjn->pin", self.weight[..., rows], shift_and_rotation)
        return derivative

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the negative derivative of the measured pose with respect to intrinsics and board scale."""
        of_camera = UnknownDerivative(
            "camera", self.camera[rows], -self.intrinsics_jacobian[..., rows].transpose(0, 1)
        )
        of_board = UnknownDerivative("board", self.board[rows], -self.scale_derivative[None, :, rows])
        return tuple(one for one in (of_camera, of_board) if one.group in unknowns)

    def _rotation_error(self, motion: ToolMotion, rows: slice) -> Float[Tensor, "3 poses"]:
        return rotation_difference(self.rotation[..., rows], motion.rotation)


def relative_position_sigmas(measurements: Measurements) -> Float64[Tensor, "rows 3"]:
    """Return standard deviations of positions, relative to the noise of a corner; NaN in rows of other sensors."""
    weight = _scaled_weights(measurements)
    from_image = measurements.is_measured("corner")
    eye = torch.eye(6).to(weight)
    root = torch.linalg.inv(torch.where(from_image[:, None, None], weight, eye))
    return torch.where(from_image[:, None], root[:, :3].norm(dim=-1), torch.nan)


def _scaled_weights(measurements: Measurements) -> Float64[Tensor, "rows 6 6"]:
    """Return the noise times W of every row; 0 in rows that are not from images."""
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
        measurements: measurements with or without rows of images.
        unknowns: estimates by group and owner; poses of other cameras and boards are not changed.
    """
    names = (NOISE_COLUMN, WEIGHT_COLUMN, CAMERA_COLUMN, INTRINSICS_COLUMN, SCALE_COLUMN)
    others = {name: values for name, values in measurements.readings.items() if name not in names}
    position, rotation = measurements.position, measurements.rotation
    if position is None or rotation is None or CAMERA_COLUMN not in measurements.readings:
        return replace(measurements, readings=others)
    images = ImageIntrinsics.from_csv_cells(texts_of(measurements, INTRINSICS_COLUMN))
    moved = np.zeros((measurements.rows, NUMBERS))
    scale = np.ones(measurements.rows)
    for row, camera in enumerate(cameras(measurements) or ()):
        moved[row] = unknowns.get("camera", {}).get(camera, images.intrinsics[row]) - images.intrinsics[row]
    for row, board in enumerate(boards(measurements) or ()):
        scale[row] += float(unknowns.get("board", {}).get(board, np.zeros(1))[0])
    change = torch.from_numpy(np.einsum("nij,nj->ni", images.pose_jacobian, moved)).to(position)
    return replace(
        measurements,
        position=(position + change[:, :3]) * torch.from_numpy(scale).to(position)[:, None],
        rotation=rotation_from_vector(change[:, 3:]) @ rotation,
        readings=others,
    )


def with_fixed_intrinsics(
    measurements: Measurements, position_sigma: float, rotation_sigma: float
) -> Measurements:
    """Return rows of images with fixed intrinsics and board scale, and with additional noise in their poses.

    Args:
        measurements: the rows.
        position_sigma: standard deviation of the additional noise of each coordinate [m].
        rotation_sigma: standard deviation of the additional noise of the rotation about each axis [rad].
    """
    added = np.diag([position_sigma**2] * 3 + [rotation_sigma**2] * 3)
    noisy = with_pose_noise(measurements, np.broadcast_to(added, (measurements.rows, 6, 6)))
    if noisy is measurements:
        return measurements
    others = {
        name: values
        for name, values in noisy.readings.items()
        if name not in (INTRINSICS_COLUMN, SCALE_COLUMN)
    }
    return replace(noisy, readings=others)


def with_pose_noise(measurements: Measurements, covariance: Float64[np.ndarray, "rows 6 6"]) -> Measurements:
    """Return rows of images with additional noise in their poses; rows of other sensors are not changed.

    Args:
        measurements: the rows.
        covariance: covariance of the additional noise of (position [m], rotation vector [rad]) of every row, in the
            axes of the row's frame.
    """
    texts = measurements.readings.get(WEIGHT_COLUMN)
    if not isinstance(texts, tuple):
        return measurements
    weights = []
    for text, added in zip(texts, covariance, strict=True):
        numbers = numbers_in(text, WEIGHTS)
        if numbers:
            W = np.zeros((6, 6))
            W[np.tril_indices(6)] = numbers
            lower = np.linalg.cholesky(np.linalg.inv(W.T @ W) + added)
            text = weight_text(np.linalg.inv(lower))
        weights.append(text)
    return replace(measurements, readings={**measurements.readings, WEIGHT_COLUMN: tuple(weights)})
