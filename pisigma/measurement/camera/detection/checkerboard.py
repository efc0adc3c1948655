"""Checkerboards in images."""

import cv2
import numpy as np
from jaxtyping import Float64

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.detection.detected_board import DetectedBoard, Image, NoBoard, refined

SMALLEST_PIECE = 3
"""Rows and columns of corners of a piece of a board that is recognised as one."""


def detect_checkerboard(image: Image, board: Board) -> DetectedBoard | NoBoard:
    """Find all corners of a checkerboard, which has to be in the image whole.

    Corners are searched by sectors (Duda & Frese 2018) and refined by their gradients, which on rendered images is as
    accurate as the search with twice the resolution, and four times as fast.

    Returns:
        The corners; those of a symmetric board are numbered from the one nearest to the upper left of the image.
    """
    there, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows))
    if not there:
        return NoBoard(_reason(image, board))
    grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    grid = _numbered(image, grid, board.is_symmetric)
    return refined(image, DetectedBoard(np.arange(len(board.corners)), grid.reshape(-1, 2)), board)


def _numbered(
    image: Image, grid: Float64[np.ndarray, "rows columns 2"], is_symmetric: bool
) -> Float64[np.ndarray, "rows columns 2"]:
    """Turn a grid of corners so that its first one is corner 0, with rows counted clockwise of columns."""
    right, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if right[0] * down[1] < right[1] * down[0]:
        grid = grid[:, ::-1]
    turned = grid[::-1, ::-1]
    if is_symmetric:
        return turned if turned[0, 0].sum() < grid[0, 0].sum() else grid
    middles = (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:]) / 4
    column, row = np.rint(middles).astype(int).reshape(-1, 2).T
    is_black = np.indices(middles.shape[:2]).sum(0).ravel() % 2 == 0
    gray = image[row, column]
    return grid if gray[is_black].mean() < gray[~is_black].mean() else turned


def _reason(image: Image, board: Board) -> str:
    """Say why no whole board was found: a piece of one is there, or none."""
    size = (SMALLEST_PIECE, SMALLEST_PIECE)
    there, _, piece = cv2.findChessboardCornersSBWithMeta(image, size, cv2.CALIB_CB_LARGER)
    wanted = f"{board.rows} x {board.columns} corners"
    if there:
        rows, columns = piece.shape
        return f"only a piece of {rows} x {columns} corners is found of a board of {wanted}"
    return f"no board of {wanted} is found in it"
