"""Printed patterns: squares meet at the corners of the board."""

import numpy as np
from testing.closeness import assert_close

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.pattern import printed_pattern


def test_black_squares_meet_at_every_corner_and_stay_on_the_sheet():
    board = Board("board", 4, 5, 0.03)
    pattern = printed_pattern(board)
    left, top, right, bottom = pattern.black_rectangles.T
    assert_close((right - left) * (bottom - top), np.full(len(left), 0.03**2), atol=1e-12)
    assert len(left) == 15
    vertices = np.concatenate([pattern.black_rectangles[:, [i, j]] for i in (0, 2) for j in (1, 3)])
    for corner in board.corners:
        touching = np.abs(vertices - corner[:2]).max(1) < 1e-9
        assert touching.sum() == 2, "two black squares touch at a corner"
    assert (pattern.sheet_rectangle[:2] < pattern.black_rectangles[:, :2].min(0)).all()
    assert (pattern.sheet_rectangle[2:] > pattern.black_rectangles[:, 2:].max(0)).all()
