"""Calibrate the intrinsics of a camera with images of a board."""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.files.output_file import check_page, write_atomically
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import INTRINSICS
from pisigma.measurement.camera.detection.detected_board import DetectedBoard
from pisigma.measurement.camera.detection.detected_boards import DetectedBoards, fit_board_poses
from pisigma.measurement.camera.detection.detector import detect_boards, image_files
from pisigma.measurement.camera.solved_images import (
    BoardView,
    IntrinsicCalibration,
    calibrate_intrinsics,
)
from pisigma.measurement.sensors.intrinsics import CAMERA_UNITS
from pisigma.reporting.result_text import Table
from pisigma.workflow.settings.images import IntrinsicsSettings

_OBLIQUE = np.deg2rad(15.0)
"""Angle [rad] that a third of the images must exceed, because frontal views do not separate focal length and
distance."""
_MIN_IMAGES = 10
"""Number of images below which a warning is given."""
_CORNER = 2
"""Number of cells of a corner of the image along each axis, a quarter of its width and height."""
CORNERS = {
    "upper left": (slice(None, _CORNER), slice(None, _CORNER)),
    "upper right": (slice(None, _CORNER), slice(-_CORNER, None)),
    "lower left": (slice(-_CORNER, None), slice(None, _CORNER)),
    "lower right": (slice(-_CORNER, None), slice(-_CORNER, None)),
}


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Result of `calibrate_camera`: a calibrated camera.

    Attributes:
        calibration: intrinsics, and coverage and tilts of the images.
        detection: boards in the images, with the corners that the calibrated camera predicts.
    """

    calibration: IntrinsicCalibration
    detection: DetectedBoards

    @property
    def parameters(self) -> list[tuple[str, float, float, str]]:
        """Name, value, standard deviation and unit of every intrinsic parameter."""
        camera = self.calibration.camera
        sigma = camera.sigma or (0.0,) * len(INTRINSICS)
        units = CAMERA_UNITS.values()
        return list(zip(INTRINSICS, camera.intrinsics.tolist(), sigma, units, strict=True))

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about detected boards, and about coverage and tilts of the images."""
        tilts = np.rad2deg(self.calibration.tilts)
        return (
            *self.detection.sentences,
            f"Corners are in {100 * self.calibration.covered_cells.mean():.0f} % of the cells of the image; views are "
            f"tilted by {np.median(tilts):.0f} deg (median), from {tilts.min():.0f} to {tilts.max():.0f} deg.",
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings, one sentence each."""
        calibration, warnings = self.calibration, list[str]()
        empty = [name for name, cells in CORNERS.items() if not calibration.covered_cells[cells].any()]
        if empty:
            warnings.append(
                f"No corner of the board is in the {' and '.join(empty)} of the image, where the distortion is "
                "extrapolated; take images with the board there."
            )
        if np.quantile(calibration.tilts, 2 / 3) < _OBLIQUE:
            warnings.append(
                f"Most images are frontal (two thirds are tilted by less than {np.rad2deg(_OBLIQUE):.0f} deg), so "
                "focal lengths can hardly be distinguished from distances; take images tilted by 20 to 40 deg."
            )
        if calibration.has_excess_scatter:
            warnings.append(
                f"The images disagree about the camera by {calibration.scatter_ratio:.2f} times the noise of "
                "corners: the board is not flat, or the lens needs --set k3=true. Standard deviations are "
                "enlarged by this factor, which does not cover errors common to all images; glue the board onto "
                "something flat."
            )
        if len(calibration.tilts) < _MIN_IMAGES:
            warnings.append(
                f"With {len(calibration.tilts)} images, one bad image distorts the result; take {_MIN_IMAGES} or more."
            )
        return tuple(warnings)

    @property
    def tables(self) -> tuple[tuple[str, Table], ...]:
        """Table of the intrinsics, one row per parameter."""
        columns = ("parameter", "value", "standard deviation", "unit")
        return (("Intrinsics", Table(columns, tuple(_row(*one) for one in self.parameters))),)

    def to_json(self) -> dict[str, object]:
        """Return all results except the corners as plain values: the result of `pisigma camera --json`."""
        calibration = self.calibration
        return {
            "camera": calibration.camera.name,
            "intrinsics": [
                {"name": name, "value": value, "sigma": sigma, "unit": unit}
                for name, value, sigma, unit in self.parameters
            ],
            "noise_px": calibration.noise,
            "disagreement": calibration.scatter_ratio,
            "covered_share": float(calibration.covered_cells.mean()),
            "tilts_deg": np.rad2deg(calibration.tilts).tolist(),
            **self.detection.to_json(),
            "sentences": list(self.sentences),
            "warnings": list(self.warnings),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the camera to a file.

        Raises:
            OutputError: the file cannot be written.
        """
        write_atomically(Path(path), self.calibration.camera.to_yaml())

    def save_page(self, page: str | os.PathLike[str]) -> None:
        """Write intrinsics and images with residuals of corners as one HTML file.

        Raises:
            OutputError: the page is not an .html file, or cannot be written.
        """
        from pisigma.reporting.page.images import images_page  # importing matplotlib takes a second

        check_page(Path(page))
        title = f"Intrinsics of {self.calibration.camera.name}"
        says = self.sentences, self.warnings
        write_atomically(Path(page), images_page(title, self.detection, self.tables, says))


def calibrate_camera(
    images: Sequence[str | os.PathLike[str]],
    board: str | os.PathLike[str],
    settings: IntrinsicsSettings = IntrinsicsSettings(),
    progress: Callable[[str], None] = lambda what: None,
) -> CameraCalibration:
    """Calibrate the intrinsics of a camera with images of a board, including standard deviations.

    Args:
        images: image files of the same size, folders of image files, or videos in which the board rests at every pose.
        board: file of the board; see `Board.load`.
        settings: see `IntrinsicsSettings`.
        progress: called with the name of every image.

    Raises:
        MeasurementError: a file cannot be used, or the images do not determine the intrinsics.
    """
    of_board = Board.load(board)
    detected = detect_boards(image_files(images), of_board, settings.max_blur, progress)
    read = [one for one in detected if one.is_readable]
    size = read[0].size
    for one in read:
        if one.size != size:
            raise MeasurementError(
                expected=f"an image of {size[0]} x {size[1]} px like {read[0].file}",
                value=Phrase(f"{one.size[0]} x {one.size[1]} px"),
                at=Place(one.file),
                remedy="give images of one camera",
            )
    boards = [one.board for one in detected if isinstance(one.board, DetectedBoard)]
    views = [BoardView(of_board.corners[one.corner_numbers], one.pixels) for one in boards]
    calibration = calibrate_intrinsics(views, settings.name, size, settings.free_k3)
    return CameraCalibration(calibration, fit_board_poses(detected, calibration.camera, of_board))


def _row(name: str, value: float, sigma: float, unit: str) -> tuple[str, ...]:
    """Return the cells of a parameter, with two digits of its standard deviation (0 if it is fixed)."""
    decimals = max(1 - math.floor(math.log10(sigma)), 0) if sigma > 0 else 0
    return (name, f"{value:.{decimals}f}", f"{sigma:.{decimals}f}" if sigma > 0 else "held", unit)
