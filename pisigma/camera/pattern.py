"""What is printed on a board: black rectangles on a white sheet, in the board's frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from pisigma.camera.board import Board


@dataclass(frozen=True, eq=False)
class Pattern:
    """A printed board, as one sees it from where its z axis comes from (x to the right, y down).

    Attributes:
        black: black rectangles that do not overlap, each as left, top, right and bottom edge [m].
        sheet: left, top, right and bottom edge of the white sheet with its quiet margin [m].
    """

    black: Float64[np.ndarray, "rectangles 4"]
    sheet: Float64[np.ndarray, " 4"]


def board_pattern(board: Board) -> Pattern:
    """Return what is printed on a board: squares one more than corners each way, the first one black.

    The quiet margin around the squares is as wide as half a square.
    """
    row, column = np.divmod(np.arange((board.rows + 1) * (board.columns + 1)), board.columns + 1)
    is_black = (row + column) % 2 == 0
    left_top = np.stack([column, row], -1)[is_black] - 1.0
    sheet = np.array([-1.5, -1.5, board.columns + 0.5, board.rows + 0.5])
    return Pattern(board.square * np.concatenate([left_top, left_top + 1], 1), board.square * sheet)
