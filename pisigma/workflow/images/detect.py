"""Detect the corners of a board in images, and write them as a file for `pisigma.calibrate`."""

import csv
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.errors import MeasurementError, Place
from pisigma.files.output_file import check_page, write_atomically
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.detection.detected_boards import DetectedBoards, predict_boards
from pisigma.measurement.camera.detection.detector import detect_boards, image_files
from pisigma.measurement.camera.detection.video import is_frame, is_video
from pisigma.measurement.foreign.image_joints import JoinedJoints, join_joint_values, names_images
from pisigma.reporting.result_text import Table
from pisigma.workflow.settings.images import DetectionSettings


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Result of `detect`: corners of a board in images, with the joint values of the images.

    Attributes:
        detection: the boards in the images.
        joints: joint values of the images; None if there is no file of joint values.
        names: names of the camera and of the board, for every row.
    """

    detection: DetectedBoards
    joints: JoinedJoints | None
    names: tuple[str, str]

    @property
    def rows(self) -> list[list[str]]:
        """Rows of the file of corners: the header, and one row per corner."""
        columns = () if self.joints is None else self.joints.columns
        rows = [["image", "camera", "board", "corner", "u_px", "v_px", *columns]]
        for name, board in self.detection.boards.items():
            cells = () if self.joints is None else self.joints.cells.get(name)
            if cells is not None:
                pairs = zip(board.corners.tolist(), board.pixels.tolist(), strict=True)
                rows += [
                    [name, *self.names, str(corner), f"{u:.4f}", f"{v:.4f}", *cells]
                    for corner, (u, v) in pairs
                ]
        return rows

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about detected boards, and about images that are left out, with the reasons."""
        return self.detection.sentences

    @property
    def warnings(self) -> tuple[str, ...]:
        """Return warnings, one sentence each."""
        return () if self.joints is None else self.joints.remarks

    @property
    def tables(self) -> tuple[tuple[str, Table], ...]:
        """No tables, because a table would have one row per corner."""
        return ()

    def to_json(self) -> dict[str, object]:
        """Return all results except the corners as plain values: the result of `pisigma detect --json`."""
        return {
            "rows": len(self.rows) - 1,
            **self.detection.to_json(),
            "sentences": list(self.sentences),
            "warnings": list(self.warnings),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the detected corners to a file.

        Raises:
            OutputError: the file cannot be written.
        """
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(self.rows)
        write_atomically(Path(path), text.getvalue())

    def save_page(self, page: str | os.PathLike[str]) -> None:
        """Write the images with residuals of corners as one HTML file.

        Raises:
            OutputError: the page is not an .html file, or cannot be written.
        """
        from pisigma.reporting.page.images import images_page  # importing matplotlib takes a second

        check_page(Path(page))
        says = self.sentences, self.warnings
        write_atomically(Path(page), images_page("Corners of a board", self.detection, self.tables, says))


def detect(
    images: Sequence[str | os.PathLike[str]],
    board: str | os.PathLike[str],
    camera: str | os.PathLike[str],
    joints: str | os.PathLike[str] | None = None,
    settings: DetectionSettings = DetectionSettings(),
    progress: Callable[[str], None] = lambda what: None,
) -> DetectedCorners:
    """Detect the corners of a board in images.

    Args:
        images: image files, folders of them, or videos of an arm that stops at every pose.
        board: file of the board; see `Board.load`.
        camera: file of the camera; see `Camera.load`.
        joints: CSV file of the joint values of the images, see `join_joint_values`; None to add them later.
        settings: see `DetectionSettings`.
        progress: called with the name of every image.

    Raises:
        MeasurementError: a file cannot be used, the board is symmetric, no image shows it, or joint values with time
            stamps are joined to a video whose start is not stated.
    """
    timed = joints is not None and not names_images(joints)
    videos = [path for path in map(Path, images) if is_video(path)]
    if timed and videos and settings.video_start is None:
        raise MeasurementError(
            "the joint values have time stamps, but the start of the video on their clock is not stated",
            expected="the time at which the video starts, by the clock of the joint values",
            value="none",
            at=Place(videos[0]),
            remedy="state it in seconds with --set video_start=S (0 if both start together)",
        )
    of_board, of_camera = Board.load(board), Camera.load(camera)
    files = image_files(images, settings.video_start if timed else None)
    if of_board.is_symmetric:
        raise MeasurementError(
            f"a checkerboard of {of_board.rows} x {of_board.columns} corners is symmetric under a rotation by 180 "
            "deg, so its first corner is ambiguous",
            value=f"{of_board.rows} x {of_board.columns}",
            at=Place(board),
            remedy="use a board with an odd sum of rows and columns, or a ChArUco board",
        )
    names, stops = [file.stem for file in files], sum(map(is_frame, files))
    joined = None if joints is None else join_joint_values(names, joints, settings.within, stops)
    detected = detect_boards(files, of_board, settings.max_blur, progress)
    result = DetectedCorners(
        predict_boards(detected, of_camera, of_board), joined, (of_camera.name, of_board.name)
    )
    if len(result.rows) == 1:
        raise MeasurementError(
            "the images with a board have no joint values",
            expected="joint values of the images",
            at=None if joints is None else Place(joints),
            remedy="add the joint values of every image",
        )
    return result
