"""Detect boards of all kinds in image files."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.files.input_file import read_input
from pisigma.measurement.camera.board import Board, BoardKind
from pisigma.measurement.camera.board_pose import MIN_CORNERS
from pisigma.measurement.camera.detection.detected_board import (
    DetectedBoard,
    EdgeProfiles,
    Image,
    NoBoard,
    edge_pixels,
    refine_corners,
)
from pisigma.measurement.camera.detection.detected_boards import BoardImage
from pisigma.measurement.camera.detection.markers import detect_apriltags, detect_charuco
from pisigma.measurement.camera.detection.video import (
    frame_path,
    is_frame,
    is_video,
    read_frame,
    still_frames,
)

_MIN_PIECE = 3
"""Smallest number of rows and columns of corners in a recognised piece of a board."""


def detect_checkerboard(image: Image, board: Board) -> DetectedBoard | NoBoard:
    """Find all corners of a checkerboard, which must be completely visible.

    Corners are found with sectors (Duda & Frese 2018) and refined with their gradients; on rendered images this is as
    accurate as the search at twice the resolution, and four times as fast.

    Returns:
        The corners; on a symmetric board, the numbering starts at the corner nearest to the upper left of the image.
    """
    there, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows))
    if not there:
        return _missing(image, board)
    grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    grid = _numbered(image, grid, board.is_symmetric)
    return refine_corners(image, DetectedBoard(np.arange(len(board.corners)), grid.reshape(-1, 2)), board)


def _numbered(
    image: Image, grid: Float64[np.ndarray, "rows columns 2"], is_symmetric: bool
) -> Float64[np.ndarray, "rows columns 2"]:
    """Rotate or mirror a grid of corners so that its first one is corner 0, with rows clockwise of columns."""
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] < right[1] * down[0]:
        grid = grid[:, ::-1]
    rotated = grid[::-1, ::-1]
    if is_symmetric:
        return rotated if rotated[0, 0].sum() < grid[0, 0].sum() else grid
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    column, row = np.rint(middles).astype(int).reshape(-1, 2).T
    is_black = np.indices(middles.shape[:2]).sum(0).ravel() % 2 == 0
    gray = image[row, column]
    return grid if gray[is_black].mean() < gray[~is_black].mean() else rotated


def _missing(image: Image, board: Board) -> NoBoard:
    """Return why no complete board was found: only part of it is visible, or none of it."""
    size = (_MIN_PIECE, _MIN_PIECE)
    there, _, piece = cv2.findChessboardCornersSBWithMeta(image, size, cv2.CALIB_CB_LARGER)
    expected = f"{board.rows} x {board.columns} corners"
    if there:
        rows, columns = piece.shape
        reason = f"only {rows} x {columns} corners of a board of {expected} were found"
        return NoBoard(reason, found_size=(rows, columns))
    return NoBoard(f"no board of {expected} was found in it")


DETECTORS: dict[BoardKind, Callable[[Image, Board], DetectedBoard | NoBoard]] = {
    "checkerboard": detect_checkerboard,
    "charuco": detect_charuco,
    "apriltag": detect_apriltags,
}
_ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""File name extensions of the images in a folder that are read."""


def image_files(
    paths: Sequence[str | os.PathLike[str]], video_start: float | None = None
) -> tuple[Path, ...]:
    """Return all image files in the given files and folders; the files of a folder are sorted by name.

    A video is a folder of its sharp frames at rest; see `still_frames`.

    Args:
        paths: image files, videos, and folders of image files.
        video_start: time of the first frame of a video on another clock [s], if frames are to be named by their time on
            that clock; None to name them by the numbers of the stops, from 1.

    Raises:
        MeasurementError: there are no images, two images have the same name, a video has no frame at rest, or several
            videos are named by time.
    """
    files, videos = list[Path](), [path for path in map(Path, paths) if is_video(path)]
    if video_start is not None and len(videos) > 1:
        raise MeasurementError(
            "several videos cannot start at the same time",
            expected="one video, because joint values are joined by time",
            value=len(videos),
            at=Place(videos[1]),
            remedy="detect the boards of every video separately, each with its start (video_start)",
        )
    for path in map(Path, paths):
        if is_video(path):
            files += _frames(path, video_start)
            continue
        inside = sorted(path.iterdir()) if path.is_dir() else ()
        files += [one for one in inside if one.suffix.lower() in _ENDINGS] if path.is_dir() else [path]
    if not files:
        raise MeasurementError(
            expected=f"images ({', '.join(_ENDINGS)})",
            value=Phrase("none"),
            at=Place(", ".join(map(str, paths))),
        )
    of_name: dict[str, Path] = {}
    for file in files:
        if (other := of_name.setdefault(file.stem, file)) != file:
            for one in (other, file):
                read_image(one)  # a file that is not an image is reported first
            raise MeasurementError(
                f"the image has the same name as {other}",
                at=Place(file),
                value=file.stem,
                remedy="give every image a different name",
            )
    return tuple(files)


def _frames(video: Path, start: float | None) -> list[Path]:
    """Return the frames at rest of a video; see `image_files`."""
    frames = still_frames(video)
    names = (
        f"{number:04d}" if start is None else f"{start + one.time:.3f}"
        for number, one in enumerate(frames, 1)
    )
    return [frame_path(video, one, name) for one, name in zip(frames, names, strict=True)]


def detect_boards(
    files: Sequence[Path],
    board: Board,
    max_blur: float = 3.0,
    progress: Callable[[str], None] = lambda name: None,
) -> list[BoardImage]:
    """Find the corners of a board in several image files; see `detect_board`.

    Raises:
        MeasurementError: no image can be used.
    """
    images = list[BoardImage]()
    for file in files:
        progress(file.name)
        try:
            images.append(detect_board(file, board, max_blur))
        except MeasurementError as problem:  # a damaged file must not stop the detection in the others
            reason = str(problem).replace(f" ({file})", "").rstrip(".")
            images.append(BoardImage(file, (0, 0), NoBoard(reason), np.nan))
    reasons = [f"{one.name}: {one.board.reason}" for one in images if isinstance(one.board, NoBoard)]
    if len(reasons) == len(files):
        raise MeasurementError(
            f"none of the {len(files)} images can be used (for example, {reasons[0]})",
            value=len(files),
            remedy="check the rows and columns of the board, and the lighting",
        )
    return images


def detect_board(path: Path, board: Board, max_blur: float) -> BoardImage:
    """Find the corners of a board in the image of a file.

    Args:
        path: the file.
        board: the board to find.
        max_blur: largest standard deviation of the blur of the board's edges [px].

    Raises:
        MeasurementError: the file cannot be read or is not an image.
    """
    image = read_image(path)
    size, detected = (image.shape[1], image.shape[0]), DETECTORS[board.kind](image, board)
    if isinstance(detected, NoBoard):
        flipped = DETECTORS[board.kind](np.ascontiguousarray(image[:, ::-1]), board) if board.marker else None
        if isinstance(flipped, DetectedBoard):
            detected = NoBoard("it is mirrored, as its markers show; do not mirror images", is_mirrored=True)
        return BoardImage(path, size, detected, np.nan)
    blur = EdgeProfiles.from_image(image, edge_pixels(detected, board), board.relative_edge_clearance).blur
    if len(detected.corner_numbers) < MIN_CORNERS:
        reason = f"expected {MIN_CORNERS} or more corners in it, got {len(detected.corner_numbers)}"
    elif blur > max_blur:
        reason = f"its edges are blurred by {blur:.1f} px (standard deviation), more than {max_blur:g} px"
    else:
        return BoardImage(path, size, detected, blur)
    return BoardImage(path, size, NoBoard(reason), blur)


def read_image(path: str | os.PathLike[str]) -> Image:
    """Return the gray values of an image file in any format that OpenCV reads, or of a frame of a video.

    The orientation in its metadata is ignored, because the intrinsics are those of the sensor.

    Raises:
        MeasurementError: the file cannot be read or is not an image.
    """
    if is_frame(Path(path)):
        return read_frame(Path(path))
    content = np.frombuffer(read_input(path, MeasurementError), dtype=np.uint8)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # the file is empty, or its header states more pixels than memory can hold
        image = None
    if _is_truncated(content.tobytes()):
        raise MeasurementError("the image is truncated", at=Place(path), remedy="copy the file again")
    if image is None:
        raise MeasurementError(
            expected="an image that OpenCV reads", at=Place(path), remedy="give PNG, JPEG, TIFF or BMP files"
        )
    return np.asarray(image, dtype=np.uint8)


def _is_truncated(content: bytes) -> bool:
    """Return whether the end of a PNG, JPEG or BMP file is missing; OpenCV would return an incomplete image."""
    if content.startswith(b"\x89PNG"):
        return b"IEND" not in content[-4096:]
    if content.startswith(b"\xff\xd8"):
        return content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda")
    if content.startswith(b"BM"):
        return len(content) < int.from_bytes(content[2:6], "little")
    return False
