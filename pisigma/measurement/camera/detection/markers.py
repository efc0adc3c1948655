"""Detection of ChArUco boards and grids of AprilTags, and the patterns of their markers."""

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from pisigma.files.errors import MeasurementError, Phrase
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.detection.detected_board import (
    DetectedBoard,
    EdgeProfiles,
    Image,
    NoBoard,
    refine_corners,
)

_ITERATIONS = 2
"""Number of searches for the sides of tags; the sides that OpenCV returns may be off by a pixel."""


def detect_charuco(image: Image, board: Board) -> DetectedBoard | NoBoard:
    """Find those corners of a ChArUco board that are next to a decoded marker, possibly only some of them."""
    size = (board.columns + 1, board.rows + 1)
    printed = cv2.aruco.CharucoBoard(size, board.square, board.marker, dictionary_of(board))
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(printed).detectBoard(image)
    if corners is None or not len(corners):
        return NoBoard(f"no corner of a ChArUco board with markers {board.dictionary} was found in it")
    pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return refine_corners(image, DetectedBoard(np.asarray(numbers, dtype=np.int64).ravel(), pixels), board)


def detect_apriltags(image: Image, board: Board) -> DetectedBoard | NoBoard:
    """Find the corners of the AprilTags that are completely visible, as intersections of lines along their sides.

    Blur rounds the corners of tags, so gradients there are biased inwards; their sides are not affected.
    """
    quads, numbers, _ = cv2.aruco.ArucoDetector(dictionary_of(board)).detectMarkers(image)
    number = np.zeros(0, dtype=np.int64) if numbers is None else np.asarray(numbers, dtype=np.int64).ravel()
    used = np.flatnonzero((number < board.rows * board.columns) & (np.bincount(number)[number] == 1))
    if not len(used):
        return NoBoard(f"no AprilTag of family {board.dictionary} of the board was found in it")
    tags = np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2)[used]
    for _ in range(_ITERATIONS):
        tags = _crossings(image, tags, board.relative_edge_clearance)
    corners = 4 * number[used, None] + np.arange(4)
    return DetectedBoard(corners.ravel(), tags.reshape(-1, 2))


def _crossings(
    image: Image, tags: Float64[np.ndarray, "tags 4 2"], clearance: float
) -> Float64[np.ndarray, "tags 4 2"]:
    """Return corners of tags as intersections of the lines fitted to their sides."""
    ends = np.stack([tags, np.roll(tags, -1, 1)], 2).reshape(-1, 2, 2)
    points = EdgeProfiles.from_image(image, ends, clearance).edge_positions
    middle = points.mean(1)
    normal = np.linalg.svd(points - middle[:, None])[2][:, -1].reshape(tags.shape)
    distance = (normal * middle.reshape(tags.shape)).sum(-1)
    both = np.stack([np.roll(normal, 1, 1), normal], 2)
    crossing: np.ndarray = np.linalg.solve(
        both, np.stack([np.roll(distance, 1, 1), distance], -1)[..., None]
    )[..., 0]
    return crossing


def dictionary_of(board: Board) -> cv2.aruco.Dictionary:
    """Return the dictionary of a board's markers; the board has the first markers of the dictionary.

    Raises:
        MeasurementError: the board has more markers than the dictionary contains.
    """
    is_grid = board.kind == "apriltag"
    name = f"APRILTAG_{board.dictionary.removeprefix('tag')}" if is_grid else board.dictionary.upper()
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
    needed = board.rows * board.columns if is_grid else (board.rows + 1) * (board.columns + 1) // 2
    if needed > (there := len(dictionary.bytesList)):
        raise MeasurementError(
            option="dictionary",
            expected=f"a dictionary with {needed} markers for board '{board.name}'",
            value=Phrase(f"{board.dictionary} with {there}"),
            remedy="choose a dictionary with more markers",
        )
    return dictionary


def marker_cells(board: Board, marker_number: int) -> Bool[np.ndarray, "cells cells"]:
    """Return the mask of a marker's black cells, row by row, including its black border."""
    dictionary = dictionary_of(board)
    return np.asarray(
        cv2.aruco.generateImageMarker(dictionary, marker_number, dictionary.markerSize + 2) == 0
    )
