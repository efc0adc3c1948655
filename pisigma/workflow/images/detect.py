"""Detect the corners of a board in images, and write them as a file for `pisigma.calibrate`.

Joint values come from a log, by the name of the image, by the number of the stop in a video, or by time.
"""

import csv
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.files.output_file import check_page, write_atomically
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.detection.detected_boards import DetectedBoards, fit_board_poses
from pisigma.measurement.camera.detection.detector import detect_boards, image_files
from pisigma.measurement.camera.detection.video import is_frame, is_video
from pisigma.measurement.csv.columns import find_column
from pisigma.measurement.csv.reading import number_column, text_column
from pisigma.measurement.csv.table import read_table
from pisigma.measurement.foreign.accounting import left_out_sentences
from pisigma.measurement.foreign.conversion import ConvertedRows
from pisigma.measurement.foreign.joining import JoinBy, join_rows
from pisigma.reporting.result_text import Table
from pisigma.workflow.settings.images import DetectionSettings

_NANOSECONDS = 1e15
"""Number above which a time is in nanoseconds, as in ROS's names of images, not in seconds."""


@dataclass(frozen=True)
class JoinedJoints:
    """Cells of a log of joint values by image.

    Attributes:
        columns: columns of the log that are kept, such as "q1_deg" and "payload_kg".
        texts_by_image: texts of these columns by image name; images without joint values are omitted.
        remarks: sentences about rows without an image, and warnings.
    """

    columns: tuple[str, ...]
    texts_by_image: Mapping[str, tuple[str, ...]]
    remarks: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class DetectedCorners:
    """Result of `detect`: corners of a board in images, with the joint values of the images.

    Attributes:
        detection: the boards in the images.
        joints: joint values of the images; None if there is no file of joint values.
        camera_and_board: names of the camera and of the board, for every row.
    """

    detection: DetectedBoards
    joints: JoinedJoints | None
    camera_and_board: tuple[str, str]

    @property
    def rows(self) -> list[list[str]]:
        """Rows of the file of corners: the header, and one row per corner."""
        columns = () if self.joints is None else self.joints.columns
        rows = [["image", "camera", "board", "corner", "u_px", "v_px", *columns]]
        for name, board in self.detection.boards.items():
            cells = () if self.joints is None else self.joints.texts_by_image.get(name)
            if cells is not None:
                pairs = zip(board.corner_numbers.tolist(), board.pixels.tolist(), strict=True)
                rows += [
                    [name, *self.camera_and_board, str(corner), f"{u:.4f}", f"{v:.4f}", *cells]
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
    timed = joints is not None and not has_image_column(joints)
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
        fit_board_poses(detected, of_camera, of_board), joined, (of_camera.name, of_board.name)
    )
    if len(result.rows) == 1:
        raise MeasurementError(
            "the images with a board have no joint values",
            expected="joint values of the images",
            at=None if joints is None else Place(joints),
            remedy="add the joint values of every image",
        )
    return result


def has_image_column(path: str | os.PathLike[str]) -> bool:
    """Return whether a log of joint values names the images; otherwise it contains times.

    Raises:
        MeasurementError: the file cannot be read.
    """
    return "image" in read_table(path).header


def join_joint_values(
    image_names: Sequence[str],
    path: str | os.PathLike[str],
    max_time_difference: float,
    stop_image_count: int = 0,
) -> JoinedJoints:
    """Return the joint values at which every image was taken.

    Args:
        image_names: names of the images without file extensions; they must be time stamps if the log has times.
        path: CSV file with joint values (`q1_deg` and so on) and a column `image` (with or without extension) or
            `time`; further columns are kept if they are columns of measurement files.
        max_time_difference: largest difference of time stamps [s].
        stop_image_count: number of images that are numbered stops in a video, which must equal the number of rows of
            the file; 0 if there is no video.

    Raises:
        MeasurementError: the file cannot be used, no image has joint values, or the number of stops differs from the
            number of rows.
    """
    table = read_table(path)
    joints = [name for name in table.header if (column := find_column(name)) and column.joint]
    by: JoinBy = "point" if "image" in table.header else "time"
    if not joints or (by == "time" and "time" not in table.header):
        raise MeasurementError(
            expected="joint values (q1_deg and so on) and a column image or time",
            value=Phrase(", ".join(table.header)),
            at=table.header_place,
        )
    if by == "point" and stop_image_count not in (0, len(table.lines)):
        raise MeasurementError(
            "the stops in the video cannot be paired with the joint values",
            expected=f"{len(table.lines)} stops in the video, one per row",
            value=stop_image_count,
            at=Place(path),
            remedy="let the arm rest for a second at every pose and nowhere else, or log joint values with times",
        )
    for name in joints:
        number_column(table, name)
    cells = {name: tuple(text_column(table, name)) for name in table.header}
    if by == "point":
        cells["point"] = tuple(os.path.splitext(os.path.basename(name))[0] for name in cells.pop("image"))
        cells.pop("time", None)
    images = {"point": tuple(image_names)} | (
        {"time": tuple(map(_stamp, image_names))} if by == "time" else {}
    )
    measured = ConvertedRows("the images", tuple(range(1, len(image_names) + 1)), images)
    joined = join_rows(measured, ConvertedRows(table.source, table.lines, cells), by, max_time_difference)
    rows = joined.rows.cells
    columns = tuple(name for name in rows if find_column(name))
    others = [name for name in rows if name not in (*columns, *images)]
    unread = [
        f"{table.source}: {', '.join(others)} are left out, because they are not columns of measurement files."
    ]
    values = zip(*(rows[name] for name in columns), strict=True)
    of_image = dict(zip(rows["point"], values, strict=True))
    remarks = (*left_out_sentences(joined.unmatched_rows), *joined.warnings, *(unread if others else ()))
    return JoinedJoints(columns, of_image, remarks)


def _stamp(name: str) -> str:
    """Return the time stamp in the name of an image as text, with nanoseconds converted to seconds."""
    try:
        return repr(int(name) * 1e-9) if int(name) > _NANOSECONDS else name
    except ValueError:
        return name
