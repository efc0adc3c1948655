"""Detection of boards of all kinds in image files."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from pisigma.files.errors import MeasurementError
from pisigma.files.input_file import read_input
from pisigma.measurement.camera.board import Board, BoardKind
from pisigma.measurement.camera.board_pose import FEWEST_CORNERS
from pisigma.measurement.camera.detection.checkerboard import detect_checkerboard
from pisigma.measurement.camera.detection.detected_board import (
    DetectedBoard,
    EdgeProfiles,
    Image,
    NoBoard,
    shown_edges,
)
from pisigma.measurement.camera.detection.detected_boards import BoardImage
from pisigma.measurement.camera.detection.markers import detect_apriltags, detect_charuco

DETECTORS: dict[BoardKind, Callable[[Image, Board], DetectedBoard | NoBoard]] = {
    "checkerboard": detect_checkerboard,
    "charuco": detect_charuco,
    "apriltag": detect_apriltags,
}
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""Of the images of a folder."""


def image_files(paths: Sequence[str | os.PathLike[str]]) -> tuple[Path, ...]:
    """List image files; those of a folder by their names.

    Raises:
        MeasurementError: there are none, or two have the same name.
    """
    files = list[Path]()
    for path in map(Path, paths):
        inside = sorted(path.iterdir()) if path.is_dir() else ()
        files += [one for one in inside if one.suffix.lower() in ENDINGS] if path.is_dir() else [path]
    if not files:
        raise MeasurementError(
            f"{', '.join(map(str, paths))}: images ({', '.join(ENDINGS)}) were wanted, but there are none."
        )
    of_name: dict[str, Path] = {}
    for file in files:
        if (other := of_name.setdefault(file.stem, file)) != file:
            for one in (other, file):
                read_image(one)  # the name of what is no image does not matter
            raise MeasurementError(f"{file}: has the name of {other}; give every image a name of its own.")
    return tuple(files)


def detect_boards(
    files: Sequence[Path],
    board: Board,
    most_blur: float = 3.0,
    progress: Callable[[str], None] = lambda name: None,
) -> list[BoardImage]:
    """Find the corners of a board in the images of some files; see `detect_board`.

    Raises:
        MeasurementError: no image can be used.
    """
    images = list[BoardImage]()
    for file in files:
        progress(file.name)
        try:
            images.append(detect_board(file, board, most_blur))
        except MeasurementError as problem:  # one damaged file does not stop the others
            images.append(
                BoardImage(file, (0, 0), NoBoard(str(problem).removeprefix(f"{file}: ").rstrip(".")), np.nan)
            )
    reasons = [f"{one.name}: {one.board.reason}" for one in images if isinstance(one.board, NoBoard)]
    if len(reasons) == len(files):
        raise MeasurementError(
            f"none of {len(files)} images can be used ({reasons[0]}); check the board's rows and columns and the light."
        )
    return images


def detect_board(path: Path, board: Board, most_blur: float) -> BoardImage:
    """Find the corners of a board in the image of a file.

    Args:
        path: the file.
        board: that is searched.
        most_blur: largest standard deviation of the blur of its edges [px].

    Raises:
        MeasurementError: the file cannot be read or is no image.
    """
    image = read_image(path)
    size, detected = (image.shape[1], image.shape[0]), DETECTORS[board.kind](image, board)
    if isinstance(detected, NoBoard):
        flipped = DETECTORS[board.kind](np.ascontiguousarray(image[:, ::-1]), board) if board.marker else None
        if isinstance(flipped, DetectedBoard):
            detected = NoBoard("it is mirrored, as its markers show; take it as the camera's sensor has it")
        return BoardImage(path, size, detected, np.nan)
    blur = EdgeProfiles.of(image, shown_edges(detected, board), board.clearance).blur
    if len(detected.corners) < FEWEST_CORNERS:
        reason = f"it shows {len(detected.corners)} corners, but {FEWEST_CORNERS} or more were wanted"
    elif blur > most_blur:
        reason = f"its edges are blurred by {blur:.1f} px (standard deviation), more than {most_blur:g} px"
    else:
        return BoardImage(path, size, detected, blur)
    return BoardImage(path, size, NoBoard(reason), blur)


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read the gray values of an image file of any format that OpenCV reads, as the sensor has them.

    It is not turned by what a camera notes of its orientation, as the intrinsics are those of the sensor.

    Raises:
        MeasurementError: it cannot be read or is no image.
    """
    content = np.frombuffer(read_input(path, MeasurementError), dtype=np.uint8)
    try:
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # it is empty, or its header states more pixels than memory can hold
        image = None
    if _is_truncated(content.tobytes()):
        raise MeasurementError(f"{path}: the image is truncated; copy the file again.")
    if image is None:
        raise MeasurementError(f"{path}: is no image that OpenCV reads; give PNG, JPEG, TIFF or BMP files.")
    return np.asarray(image, dtype=np.uint8)


def _is_truncated(content: bytes) -> bool:
    """Whether the end of a PNG or JPEG file is missing, of which OpenCV gives what is there."""
    if content.startswith(b"\x89PNG"):
        return b"IEND" not in content[-4096:]
    if content.startswith(b"\xff\xd8"):
        return content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda")
    if content.startswith(b"BM"):
        return len(content) < int.from_bytes(content[2:6], "little")
    return False
