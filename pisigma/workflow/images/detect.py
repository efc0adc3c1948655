"""Find the corners of a board in images, as a file that `pisigma.calibrate` takes."""

import csv
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pisigma.camera.board import Board
from pisigma.camera.camera import Camera
from pisigma.camera.detection.detector import (
    MOST_BLUR,
    DetectedBoards,
    detect_board,
    image_files,
    predict_boards,
)
from pisigma.camera.detection.joined_joints import JoinedJoints, join_joints
from pisigma.errors import MeasurementError
from pisigma.files.output_file import write_whole
from pisigma.measurement.foreign.joining import WITHIN


@dataclass(frozen=True)
class DetectionSettings:
    """How corners are detected.

    Attributes:
        most_blur: images whose edges have a larger standard deviation of blur are left out [px].
        within: largest difference of time stamps of images and joint values [s].
    """

    most_blur: float = MOST_BLUR
    within: float = WITHIN


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Corners of a board in images, with the joint values of the images.

    Attributes:
        detection: the boards in the images.
        joints: of the images; None where no log was stated.
    """

    detection: DetectedBoards
    joints: JoinedJoints | None

    @property
    def rows(self) -> list[list[str]]:
        """The file of corners: its header, and a row a corner."""
        columns = () if self.joints is None else self.joints.columns
        rows = [["image", "corner", "u_px", "v_px", *columns]]
        for name, board in self.detection.boards.items():
            cells = () if self.joints is None else self.joints.cells.get(name)
            if cells is not None:
                pairs = zip(board.corners.tolist(), board.pixels.tolist(), strict=True)
                rows += [[name, str(corner), f"{u:.4f}", f"{v:.4f}", *cells] for corner, (u, v) in pairs]
        return rows

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, and what is left out and why."""
        images, boards = self.detection.images, self.detection.boards
        count = sum(len(board.corners) for board in boards.values())
        used = [one for one in images if one.name in boards]
        blurred = max(used, key=lambda one: one.blur)
        reasons = [f"{name} is left out: {reason}." for name, reason in self.detection.left_out.items()]
        return (
            f"{len(boards)} of {len(images)} images show the board: {count:,} corners, which the pose of the board in "
            f"each image predicts to {self.detection.rms:.3f} px (RMS of u and v).",
            f"Edges are blurred by {np.median([one.blur for one in used]):.2f} px (median of the standard deviations), "
            f"most of all by {blurred.blur:.2f} px in {blurred.name}.",
            *reasons,
            *(() if self.joints is None else self.joints.remarks),
        )

    def to_json(self) -> dict[str, object]:
        """Return everything but the corners as plain values: the result of `pisigma detect --json`."""
        residuals, boards = self.detection.residuals, self.detection.boards
        return {
            "rows": len(self.rows) - 1,
            "rms_px": self.detection.rms,
            "images": [
                {
                    "image": one.name,
                    "file": str(one.file),
                    "corners": len(boards[one.name].corners) if one.name in boards else 0,
                    "rms_px": float(np.sqrt(np.square(residuals[one.name]).mean()))
                    if one.name in boards
                    else None,
                    "blur_px": one.blur if np.isfinite(one.blur) else None,
                    "left_out": self.detection.left_out.get(one.name),
                }
                for one in self.detection.images
            ],
            "sentences": list(self.sentences),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the file of corners.

        Raises:
            OutputError: it cannot be written.
        """
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(self.rows)
        write_whole(Path(path), text.getvalue())


def detect(
    images: Sequence[str | os.PathLike[str]],
    board: str | os.PathLike[str],
    camera: str | os.PathLike[str],
    joints: str | os.PathLike[str] | None = None,
    settings: DetectionSettings = DetectionSettings(),
    progress: Callable[[str], None] = lambda what: None,
) -> DetectedCorners:
    """Find the corners of a board in images.

    Args:
        images: files, or folders of them.
        board: its file, see `Board.load`.
        camera: its file, see `Camera.load`.
        joints: CSV file of the joint values of the images, see `join_joints`; None where they are added later.
        settings: see `DetectionSettings`.
        progress: called with the name of every image.

    Raises:
        MeasurementError: a file cannot be used, the board is symmetric, or no image shows it.
    """
    files, of_board, of_camera = image_files(images), Board.load(board), Camera.load(camera)
    if of_board.is_symmetric:
        raise MeasurementError(
            f"{board}: a checkerboard of {of_board.rows} x {of_board.columns} corners looks the same turned by 180 "
            "deg, so that no image says which corner is the first; use one with an odd sum of rows and columns, or a "
            "ChArUco board."
        )
    joined = None if joints is None else join_joints([file.stem for file in files], joints, settings.within)
    detected = []
    for file in files:
        progress(file.name)
        detected.append(detect_board(file, of_board, settings.most_blur))
    result = DetectedCorners(predict_boards(detected, of_camera, of_board), joined)
    if len(result.rows) == 1:
        reasons = [f"{name}: {reason}" for name, reason in result.detection.left_out.items()]
        first = (reasons or ["those with a board lack joint values"])[0]
        raise MeasurementError(
            f"none of {len(files)} images can be used ({first}); check the board's rows and columns, and the light."
        )
    return result
