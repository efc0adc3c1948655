"""Information in images on their camera's intrinsics and on the scale of their board, with poses eliminated."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.readings import ReadingColumn
from pisigma.measurement.sensors.sensor import (
    AbstractSensor,
    Derivative,
    InitialUnknowns,
    OtherUnit,
    Poses,
    SensorRows,
    UnknownDerivative,
    UnknownGroup,
    Unknowns,
    Values,
    distinct_names,
    indices_of_names,
    owners_of,
)
from pisigma.robot.kinematics.parameter_jacobian import ToolMotion

NOISE_COLUMN, CAMERA_COLUMN = "corner_noise", "corner_camera"
INTRINSICS_COLUMN, SCALE_COLUMN = "corner_intrinsics", "corner_scale"
COLUMNS = tuple(
    ReadingColumn(name, is_text=True, is_optional=True)
    for name in (CAMERA_COLUMN, INTRINSICS_COLUMN, SCALE_COLUMN)
)
_PIXELS: tuple[str, ...] = ("fx", "fy", "cx", "cy")
CAMERA_UNITS: dict[str, OtherUnit] = {
    name: "px" if name in _PIXELS else "1" for name in (*_PIXELS, "k1", "k2", "p1", "p2", "k3")
}
NUMBERS = len(CAMERA_UNITS)
_UNINFORMATIVE = 1e3
"""Factor on stated standard deviations that makes the prior negligible relative to the images."""
_USUAL_SCALE = 1e-3
"""Relative standard deviation of a board's scale if the board file does not state one: the error of printers and
paper."""


@dataclass(frozen=True, eq=False)
class ImageIntrinsics:
    """Information from the corners of images about their camera's intrinsics k, linearised at `intrinsics`.

    Attributes:
        pose_jacobian: derivative of the measured position and rotation vector, in the axes of the row's frame, with
            respect to k.
        information_root: matrix of the equations of k with the poses eliminated, `root (k - intrinsics) =
            information_residual` with unit variances.
        information_residual: right-hand side of the equations of `information_root`.
        intrinsics: intrinsics at which the images were linearised.
        prior_mean: intrinsics of the camera file, the prior mean.
        prior_sigma: prior standard deviations; 0 for fixed intrinsics.
    """

    pose_jacobian: Float64[np.ndarray, "*rows 6 9"]
    information_root: Float64[np.ndarray, "*rows 9 9"]
    information_residual: Float64[np.ndarray, "*rows 9"]
    intrinsics: Float64[np.ndarray, "*rows 9"]
    prior_mean: Float64[np.ndarray, "*rows 9"]
    prior_sigma: Float64[np.ndarray, "*rows 9"]

    def select(self, rows: Bool[np.ndarray, " rows"]) -> "ImageIntrinsics":
        """Return the information of the chosen images."""
        return ImageIntrinsics(*(getattr(self, item.name)[rows] for item in fields(self)))

    @property
    def csv_cells(self) -> tuple[str, ...]:
        """Cells of the column of intrinsics: all numbers of an image as text, separated by spaces."""
        blocks = [getattr(self, item.name).reshape(len(self.intrinsics), -1) for item in fields(self)]
        return tuple(" ".join(f"{value:.17g}" for value in row) for row in np.concatenate(blocks, 1))

    @staticmethod
    def from_csv_cells(cells: tuple[str, ...]) -> "ImageIntrinsics":
        """Return the information in cells of the column of intrinsics; 0 for empty cells."""
        empty = [0.0] * SIZE
        block = np.array([numbers_in(text, SIZE) or empty for text in cells]).reshape(-1, 19, NUMBERS)
        return ImageIntrinsics(block[:, :6], block[:, 6:15], *(block[:, row] for row in range(15, 19)))


SIZE = 19 * NUMBERS
"""Number of values in a cell of the column of intrinsics."""


def intrinsics_information(
    images: ImageIntrinsics,
) -> tuple[Float64[np.ndarray, "9 9"], Float64[np.ndarray, " 9"]]:
    """Sum the information of the images and the prior of one camera on its intrinsics, with poses eliminated.

    Returns:
        U [1/px; 1 for distortion], where `U^T U` is the information (0 for fixed intrinsics), and the mean [px; 1 for
        distortion].
    """
    sigma, at = images.prior_sigma[0], images.intrinsics[0]
    free = np.flatnonzero(sigma > 0)
    # in units of the prior standard deviations, in which the information of the prior is the identity
    scaled = images.information_root[:, :, free] * sigma[free]
    information = np.eye(len(free)) + np.einsum("nij,nik->jk", scaled, scaled)
    residual = images.information_residual + np.einsum(
        "nij,nj->ni", images.information_root, images.intrinsics - at
    )
    pull = np.einsum("nij,ni->j", scaled, residual) + (images.prior_mean[0] - at)[free] / sigma[free]
    U, mean = np.zeros((NUMBERS, NUMBERS)), at.copy()
    U[np.ix_(free, free)] = np.linalg.cholesky(information).T / sigma[free]
    mean[free] += sigma[free] * np.linalg.solve(information, pull)
    return U, mean


def without_stated_priors(
    measurements: Measurements, included: Mapping[str, Collection[str]]
) -> Measurements:
    """Return rows of images without the priors of some cameras and boards.

    Args:
        measurements: measurements with or without rows of images.
        included: cameras and boards, by group, whose priors a model already includes.
    """
    if CAMERA_COLUMN not in measurements.readings:
        return measurements
    stated, scales = (texts_of(measurements, name) for name in (INTRINSICS_COLUMN, SCALE_COLUMN))
    images, names = ImageIntrinsics.from_csv_cells(stated), cameras(measurements) or ("",) * len(stated)
    is_counted = np.array([name in included.get("camera", ()) for name in names])
    images = replace(
        images, prior_sigma=np.where(is_counted[:, None], _UNINFORMATIVE, 1.0) * images.prior_sigma
    )
    texts = {
        INTRINSICS_COLUMN: tuple(
            text if name else "" for name, text in zip(names, images.csv_cells, strict=True)
        ),
        SCALE_COLUMN: tuple(
            "1" if board in included.get("board", ()) else text
            for board, text in zip(boards(measurements) or (), scales, strict=True)
        ),
    }
    return replace(measurements, readings={**measurements.readings, **texts})


def numbers_in(text: str, count: int) -> list[float]:
    """Return `count` numbers separated by spaces in a text; empty if the text is anything else."""
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return []
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else []


def texts_of(measurements: Measurements, name: str) -> tuple[str, ...]:
    """Return a text column of a registered sensor; "" in every row if it does not exist."""
    return measurements.as_fields().text(name)


def cameras(measurements: Measurements) -> tuple[str, ...] | None:
    """Return the name of each row's camera with estimated intrinsics, or ""; None if no row has one."""
    stated = zip(
        texts_of(measurements, CAMERA_COLUMN), texts_of(measurements, INTRINSICS_COLUMN), strict=True
    )
    names = tuple(camera if numbers else "" for camera, numbers in stated)
    return names if any(names) else None


def boards(measurements: Measurements) -> tuple[str, ...] | None:
    """Return the name of the board in each row's image: the frame or the target, whichever is not the camera.

    Boards without a name are named "board".
    """
    cells = zip(texts_of(measurements, CAMERA_COLUMN), measurements.frame, measurements.target, strict=True)
    names = tuple(
        (target if frame == camera else frame) or "board" if camera else "" for camera, frame, target in cells
    )
    return names if any(names) else None


def scale_sigmas(measurements: Measurements) -> Float64[Tensor, " boards"]:
    """Return the relative prior standard deviation of the scale of every board, 0 for fixed scales.

    A scale is fixed if no deviation is stated and no other row has a length that could determine the scale.
    """
    names, stated = boards(measurements), texts_of(measurements, SCALE_COLUMN)
    other_lengths = bool((~measurements.is_measured("corner") & ~measurements.is_measured("rotation")).any())
    usual = _USUAL_SCALE if other_lengths else 0.0
    texts = [stated[(names or ()).index(board)] for board in distinct_names(names)]
    return torch.tensor([float(text) if text else usual for text in texts], dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class IntrinsicsSensor(AbstractSensor):
    """Information of all images of a camera and of the prior on the intrinsics, as the value of one row.

    The poses of the boards are eliminated from the images (variable projection, Golub and Pereyra 1973); the remaining
    information is summed over the images and the prior. Values are `U (mean - k)`, where `U^T U` is the information,
    times the noise of one corner, expressed as a length at the board.

    Attributes:
        owner: index of the camera of every row, -1 in rows without a value.
        information_root: noise times U [m per px or 1].
        mean: combined estimate of k [px or 1].
        present: mask of the rows that have the value of a camera.
        sigma: the noise [m].
    """

    name = "intrinsics"
    unit = "m"
    components = NUMBERS
    are_values_given = True
    determines_frame = False
    owner: Int64[Tensor, " rows"]
    information_root: Float64[Tensor, "9 9 rows"]
    mean: Float64[Tensor, "9 rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"]

    @classmethod
    def build(cls, rows: SensorRows) -> "IntrinsicsSensor | None":
        """Build the sensor with the information on every camera; None if no intrinsics are estimated."""
        data, names = rows.measurements, cameras(rows.measurements)
        if names is None or not bool(rows.has_corner_poses.any()):
            return None
        images = ImageIntrinsics.from_csv_cells(texts_of(data, INTRINSICS_COLUMN))
        noise = torch.nan_to_num(rows.readings(NOISE_COLUMN), nan=1.0)
        number = indices_of_names(names, distinct_names(names), data.rows).numpy()
        owners = np.full(data.rows, -1)
        roots, means = np.zeros((NUMBERS, NUMBERS, data.rows)), np.zeros((NUMBERS, data.rows))
        for camera in range(number.max() + 1):
            chosen = number == camera
            first = int(chosen.argmax())
            U, means[:, first] = intrinsics_information(images.select(chosen))
            owners[first], roots[..., first] = camera, U * float(noise[first])
        owner, root, mean = (torch.from_numpy(those).to(noise.device) for those in (owners, roots, means))
        return cls(owner, root, mean, owner >= 0, noise)

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the weighted errors of the intrinsics [m]."""
        error = self.mean[:, rows] - unknowns["camera"][:, self.owner[rows]]
        residual: Tensor = torch.einsum("ijn,jn->in", self.information_root[..., rows], error)
        return residual

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return 0, because the values do not depend on the tool."""
        return torch.zeros_like(motion.derivative[:, :1]).expand(-1, NUMBERS, -1)

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives of the values with respect to the intrinsics: the weights."""
        return (
            UnknownDerivative("camera", self.owner[rows], self.information_root[..., rows].transpose(0, 1)),
        )

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Return the cameras whose intrinsics are estimated."""
        owners, frames = owners_of(measurements, cameras(measurements))
        return (
            UnknownGroup("camera", tuple(CAMERA_UNITS), owners, frames, units=CAMERA_UNITS)
            if owners
            else None
        )

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Return the prior means of the intrinsics; intrinsics without a standard deviation are fixed."""
        names = cameras(measurements)
        if names is None:
            return None
        images = ImageIntrinsics.from_csv_cells(texts_of(measurements, INTRINSICS_COLUMN))
        first = [names.index(name) for name in distinct_names(names)]
        return InitialUnknowns(
            torch.from_numpy(images.prior_mean[first]), torch.from_numpy(images.prior_sigma[first] > 0)
        )


@dataclass(frozen=True, eq=False)
class BoardScalePrior(AbstractSensor):
    """The prior of the scale of a board, as the value of one row.

    With the unknown s, every length of the board is `1 + s` times its stated length.

    Attributes:
        owner: index of the board of every row, -1 in rows without a value.
        weight: the noise divided by the prior standard deviation of s [m].
        present: mask of the rows that have the value of a board.
        sigma: standard deviation of the values [m]: the noise of one corner as a length at the board.
    """

    name = "board scale"
    unit = "m"
    components = 1
    are_values_given = True
    determines_frame = False
    owner: Int64[Tensor, " rows"]
    weight: Float64[Tensor, " rows"]
    present: Bool[Tensor, " rows"]
    sigma: Float64[Tensor, " rows"]

    @classmethod
    def build(cls, rows: SensorRows) -> "BoardScalePrior | None":
        """Build the sensor with every board of free scale assigned to its first row; None if there is no such board."""
        data, names = rows.measurements, boards(rows.measurements)
        deviations = scale_sigmas(data)
        if names is None or not bool((deviations > 0).any()) or not bool(rows.has_corner_poses.any()):
            return None
        noise = torch.nan_to_num(rows.readings(NOISE_COLUMN), nan=1.0)
        owner, weight = torch.full((data.rows,), -1).to(noise.device), torch.zeros_like(noise)
        for number, name in enumerate(distinct_names(names)):
            row, deviation = names.index(name), float(deviations[number])
            if deviation > 0:
                owner[row], weight[row] = number, noise[row] / deviation
        return cls(owner, weight, owner >= 0, noise)

    def residual(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Values:
        """Return the negative scale divided by its standard deviation, times the noise [m]."""
        scale = unknowns["board"][:, self.owner[rows]]
        residual: Tensor = -scale * self.weight[rows]
        return residual

    def derivative(self, motion: ToolMotion, unknowns: Unknowns, rows: slice) -> Derivative:
        """Return 0, because the values do not depend on the tool."""
        return torch.zeros_like(motion.derivative[:, :1])

    def unknown_derivatives(
        self, motion: ToolMotion, unknowns: Unknowns, rows: slice
    ) -> tuple[UnknownDerivative, ...]:
        """Return the derivatives of the values with respect to the scales: the weights."""
        return (UnknownDerivative("board", self.owner[rows], self.weight[None, None, rows]),)

    @classmethod
    def unknowns(cls, measurements: Measurements) -> UnknownGroup | None:
        """Return the boards whose scale is estimated."""
        owners, frames = owners_of(measurements, boards(measurements))
        return UnknownGroup("board", ("scale",), owners, frames, units={"scale": "1"}) if owners else None

    @classmethod
    def initial_guess(
        cls, measurements: Measurements, T_frame_tool: Poses, reach: float
    ) -> InitialUnknowns | None:
        """Return 0, the stated scale, for every board."""
        if boards(measurements) is None:
            return None
        free = scale_sigmas(measurements)[:, None] > 0
        return InitialUnknowns(torch.zeros(free.shape, dtype=torch.float64), free)
