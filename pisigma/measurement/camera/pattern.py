"""Printed patterns of boards: black rectangles on a white sheet, in the frame of the board."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.measurement.camera.board import Board


@dataclass(frozen=True, eq=False)
class Pattern:
    """A printed board, seen along its z axis (x to the right, y down).

    Attributes:
        black_rectangles: left, top, right and bottom edge [m] of black rectangles that do not overlap.
        sheet_rectangle: left, top, right and bottom edge of the white sheet, including its margin [m].
    """

    black_rectangles: Float64[np.ndarray, "rectangles 4"]
    sheet_rectangle: Float64[np.ndarray, " 4"]


def printed_pattern(board: Board) -> Pattern:
    """Return the pattern of a board, with a white margin of half a square.

    Checkerboards have one more square than corners in each direction, the first one black. ChArUco boards have the
    markers 0, 1 and so on in their white squares, row by row, and grids of AprilTags the tags 0, 1 and so on.

    Raises:
        MeasurementError: the board has more markers than its dictionary.
        ImportError: OpenCV, which draws markers, is not installed.
    """
    if board.kind == "apriltag":
        return Pattern(_markers(board, board.corners[::4, :2]), board_sheet(board))
    row, column = np.divmod(np.arange((board.rows + 1) * (board.columns + 1)), board.columns + 1)
    is_black = (row + column) % 2 == 0
    left_top = board.square * (np.stack([column, row], -1) - 1.0)
    black = np.concatenate([left_top, left_top + board.square], 1)[is_black]
    if board.kind == "charuco":
        markers = _markers(board, left_top[~is_black] + (board.square - board.marker) / 2)
        black = np.concatenate([black, markers])
    return Pattern(black, board_sheet(board))


def board_sheet(board: Board) -> Float64[np.ndarray, " 4"]:
    """Return left, top, right and bottom edge of the white sheet of a board, including its margin [m]."""
    if board.kind == "apriltag":
        margin = board.square / 2
        return np.array([-margin, -margin, *board.corners.max(0)[:2] + margin])
    return board.square * np.array([-1.5, -1.5, board.columns + 0.5, board.rows + 0.5])


def _markers(board: Board, left_top: np.ndarray) -> Float64[np.ndarray, "rectangles 4"]:
    """Return the black rectangles of markers (runs of black cells in a row), given their upper left corners."""
    from pisigma.measurement.camera.detection.markers import marker_cells  # a package of the extra `camera`

    rectangles = []
    for number, at in enumerate(left_top):
        cells = marker_cells(board, number)
        ends = np.diff(np.pad(cells, ((0, 0), (1, 1))).astype(int), axis=1)
        (row, first), (_, last) = np.nonzero(ends == 1), np.nonzero(ends == -1)
        rectangles.append(
            np.tile(at, 2) + board.marker / len(cells) * np.stack([first, row, last, row + 1], -1)
        )
    return np.concatenate(rectangles)
