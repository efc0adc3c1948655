"""Detection of boards of all kinds in image files."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from pisigma.camera.board import Board, BoardKind
from pisigma.camera.board_pose import FEWEST_CORNERS, solve_board_pose
from pisigma.camera.camera import Camera
from pisigma.camera.detection.checkerboard import detect_checkerboard
from pisigma.camera.detection.detected_board import DetectedBoard, EdgeProfiles, Image, NoBoard, shown_edges
from pisigma.camera.detection.markers import detect_apriltags, detect_charuco
from pisigma.camera.image_rows import LARGEST_MISS
from pisigma.errors import MeasurementError
from pisigma.files.input_file import read_input
from pisigma.identification.problem.loss import HampelLoss

MOST_BLUR = 3.0
"""[px] Images whose edges are blurred more are left out unless another limit is stated."""
DETECTORS: dict[BoardKind, Callable[[Image, Board], DetectedBoard | NoBoard]] = {
    "checkerboard": detect_checkerboard,
    "charuco": detect_charuco,
    "apriltag": detect_apriltags,
}
ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")
"""Of the images of a folder."""


@dataclass(frozen=True, eq=False)
class BoardImage:
    """The image of a file, and the board in it.

    Attributes:
        file: of the image.
        size: its width and height [px].
        board: the corners that can be used, or why there are none.
        blur: standard deviation of the blur of the board's edges [px]; NaN where none was found.
    """

    file: Path
    size: tuple[int, int]
    board: DetectedBoard | NoBoard
    blur: float

    @property
    def name(self) -> str:
        """That of the file, without ending."""
        return self.file.stem


@dataclass(frozen=True, eq=False)
class DetectedBoards:
    """Boards in images, and where their poses predict the corners.

    Attributes:
        images: with a board and without, in the order of the files.
        predicted: pixels of the corners of every image that has some, by its name [px].
    """

    images: tuple[BoardImage, ...]
    predicted: dict[str, Float64[np.ndarray, "_corners 2"]]

    @property
    def boards(self) -> dict[str, DetectedBoard]:
        """The boards that can be used, by the names of their images."""
        return {one.name: one.board for one in self.images if isinstance(one.board, DetectedBoard)}

    @property
    def left_out(self) -> dict[str, str]:
        """Why images have no board that can be used, by their names."""
        return {one.name: one.board.reason for one in self.images if isinstance(one.board, NoBoard)}

    @property
    def residuals(self) -> dict[str, Float64[np.ndarray, "_corners 2"]]:
        """Detected minus predicted pixels, by the names of the images [px]."""
        return {name: board.pixels - self.predicted[name] for name, board in self.boards.items()}

    @property
    def rms(self) -> float:
        """Root mean square of u and v of the residuals [px]; NaN without corners."""
        residuals = list(self.residuals.values())
        return float(np.sqrt(np.square(np.concatenate(residuals)).mean())) if residuals else np.nan


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
            raise MeasurementError(f"{file}: has the name of {other}; give every image a name of its own.")
    return tuple(files)


def detect_board(path: Path, board: Board, most_blur: float = MOST_BLUR) -> BoardImage:
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
        return BoardImage(path, size, detected, np.nan)
    blur = EdgeProfiles.of(image, shown_edges(detected, board), board.clearance).blur
    if len(detected.corners) < FEWEST_CORNERS:
        reason = f"it shows {len(detected.corners)} corners, but {FEWEST_CORNERS} or more were wanted"
    elif blur > most_blur:
        reason = f"its edges are blurred by {blur:.1f} px (standard deviation), more than {most_blur:g} px"
    else:
        return BoardImage(path, size, detected, blur)
    return BoardImage(path, size, NoBoard(reason), blur)


def predict_boards(images: Sequence[BoardImage], camera: Camera, board: Board) -> DetectedBoards:
    """Predict corners by the pose of the board in every image; images that no pose explains lose their corners.

    Raises:
        MeasurementError: an image is not as large as those of the camera.
    """
    checked, predicted, corners = list[BoardImage](), {}, board.corners
    for one in images:
        if one.size != (camera.width, camera.height):
            raise MeasurementError(
                f"{one.file}: an image of {camera.width} x {camera.height} px was wanted, as the camera "
                f"'{camera.name}' takes them, got {one.size[0]} x {one.size[1]}; check the camera."
            )
        if isinstance(one.board, DetectedBoard):
            at = corners[one.board.corners]
            pose = solve_board_pose(camera, at, one.board.pixels, HampelLoss())
            if (miss := float(np.median(pose.distance))) < LARGEST_MISS:
                predicted[one.name] = camera.project(at @ pose.R.T + pose.t)[0]
            else:
                reason = f"half of its corners miss board and camera by {miss:.3g} px or more"
                one = BoardImage(one.file, one.size, NoBoard(reason), one.blur)
        checked.append(one)
    return DetectedBoards(tuple(checked), predicted)


def read_image(path: str | os.PathLike[str]) -> Image:
    """Read the grey values of an image file of any format that OpenCV reads.

    Raises:
        MeasurementError: it cannot be read or is no image.
    """
    content = np.frombuffer(read_input(path, MeasurementError), dtype=np.uint8)
    image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if len(content) else None
    if image is None:
        raise MeasurementError(f"{path}: is no image that OpenCV reads; give PNG, JPEG, TIFF or BMP files.")
    return np.asarray(image, dtype=np.uint8)
