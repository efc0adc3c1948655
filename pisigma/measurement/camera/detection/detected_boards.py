"""Boards in several images, and the residuals of their corners."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from pisigma.estimation.loss import HampelLoss
from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import solve_board_pose
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.detection.detected_board import DetectedBoard, NoBoard
from pisigma.measurement.camera.image_rows import MAX_MEDIAN_RESIDUAL


@dataclass(frozen=True, eq=False)
class BoardImage:
    """An image file, and the board in the image.

    Attributes:
        file: the image file.
        size: width and height of the image [px]; 0 if the file cannot be read.
        board: the usable corners, or the reason why the image has none.
        blur: standard deviation of the blur of the board's edges [px]; NaN if no board was found.
    """

    file: Path
    size: tuple[int, int]
    board: DetectedBoard | NoBoard
    blur: float

    @property
    def name(self) -> str:
        """Name of the file without its extension."""
        return self.file.stem

    @property
    def is_readable(self) -> bool:
        """Whether the file is a complete image."""
        return self.size != (0, 0)


@dataclass(frozen=True, eq=False)
class DetectedBoards:
    """Boards in images, with the corners that the solved poses predict.

    Attributes:
        images: all images, in the order of the files.
        predicted_pixels: predicted pixels [px] of the corners of every image with a board, by image name.
    """

    images: tuple[BoardImage, ...]
    predicted_pixels: dict[str, Float64[np.ndarray, "_corners 2"]]

    @property
    def boards(self) -> dict[str, DetectedBoard]:
        """Usable boards by image name."""
        return {one.name: one.board for one in self.images if isinstance(one.board, DetectedBoard)}

    @property
    def left_out(self) -> dict[str, str]:
        """Reasons why images have no usable board, by image name."""
        return {one.name: one.board.reason for one in self.images if isinstance(one.board, NoBoard)}

    @property
    def residuals(self) -> dict[str, Float64[np.ndarray, "_corners 2"]]:
        """Detected minus predicted pixels [px] by image name."""
        return {name: board.pixels - self.predicted_pixels[name] for name, board in self.boards.items()}

    @property
    def rms(self) -> float:
        """Root mean square of the u and v components of all residuals [px]; NaN without corners."""
        residuals = list(self.residuals.values())
        return rms_of(np.concatenate(residuals)) if residuals else np.nan

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about used images and images that were left out; at least one board must be usable."""
        boards = self.boards
        count = sum(len(board.corner_numbers) for board in boards.values())
        used = [one for one in self.images if one.name in boards]
        blurred = max(used, key=lambda one: one.blur)
        return (
            f"{len(boards)} of {len(self.images)} images show the board: {count:,} corners, with RMS residuals of "
            f"{self.rms:.3f} px (u and v) after solving the pose of the board in each image.",
            f"The blur of edges has a median standard deviation of {np.median([one.blur for one in used]):.2f} px; the "
            f"largest is {blurred.blur:.2f} px, in {blurred.name}.",
            *(f"{name} is left out: {reason}." for name, reason in self.left_out.items()),
        )

    def to_json(self) -> dict[str, object]:
        """Return residuals, blur and reasons of all images as plain values for JSON."""
        residuals, left_out = self.residuals, self.left_out
        return {
            "rms_px": self.rms,
            "images": [
                {
                    "image": one.name,
                    "file": str(one.file),
                    "corners": len(residuals.get(one.name, ())),
                    "rms_px": None if one.name in left_out else rms_of(residuals[one.name]),
                    "blur_px": one.blur if np.isfinite(one.blur) else None,
                    "left_out": left_out.get(one.name),
                }
                for one in self.images
            ],
        }


def rms_of(residual: Float64[np.ndarray, "*corners 2"]) -> float:
    """Return the root mean square of the u and v components of residuals [px]."""
    return float(np.sqrt(np.square(residual).mean()))


def fit_board_poses(images: Sequence[BoardImage], camera: Camera, board: Board) -> DetectedBoards:
    """Fit the pose of the board in every image, predict its corners, and drop images for which no pose fits.

    Raises:
        MeasurementError: the size of an image differs from that of the camera's images.
    """
    checked, predicted, corners = list[BoardImage](), {}, board.corners
    for one in images:
        if one.is_readable and one.size != (camera.width, camera.height):
            raise MeasurementError(
                expected=f"an image of {camera.width} x {camera.height} px of camera '{camera.name}'",
                value=Phrase(f"{one.size[0]} x {one.size[1]} px"),
                at=Place(one.file),
                remedy="check the camera",
            )
        if isinstance(one.board, DetectedBoard):
            at = corners[one.board.corner_numbers]
            pose = solve_board_pose(camera, at, one.board.pixels, HampelLoss())
            if (residual := float(np.median(pose.residual_length))) < MAX_MEDIAN_RESIDUAL:
                predicted[one.name] = camera.project(at @ pose.R.T + pose.t)[0]
            else:
                reason = f"the median residual of its corners with this board and camera is {residual:.3g} px"
                one = replace(one, board=NoBoard(reason))
        checked.append(one)
    return DetectedBoards(tuple(checked), predicted)
