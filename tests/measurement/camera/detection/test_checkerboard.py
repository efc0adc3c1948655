"""Corners of checkerboards in rendered images: positions, numbering, and missing boards."""

import numpy as np
import pytest
from testing.board_images import CAMERA, draw_board, view
from testing.closeness import assert_close

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.detection.detected_board import DetectedBoard, EdgeProfiles, NoBoard
from pisigma.measurement.camera.detection.detector import detect_checkerboard

BOARD = Board("board", 4, 5, 0.03)


@pytest.mark.parametrize("roll", [0.0, 1.5, 3.0, -1.7])
def test_corners_are_found_and_numbered_at_any_rotation_of_the_camera(roll: float) -> None:
    R, t = view(BOARD, 0.35, (roll, 0.4, -0.3))
    detected = detect_checkerboard(draw_board(BOARD, R, t), BOARD)
    assert isinstance(detected, DetectedBoard)
    assert detected.corner_numbers.tolist() == list(range(20))
    true = CAMERA.project(BOARD.corners @ R.T + t)[0]
    assert_close(detected.pixels, true, atol=0.08)
    assert_close(np.sqrt(np.square(detected.pixels - true).mean()), 0.0, atol=0.03)


def test_a_symmetric_board_is_numbered_from_the_upper_left() -> None:
    board = Board("board", 4, 4, 0.03)
    R, t = view(board, 0.35, (3.0, 0.3, 0.0))
    detected = detect_checkerboard(draw_board(board, R, t), board)
    assert isinstance(detected, DetectedBoard)
    true = CAMERA.project(board.corners @ R.T + t)[0]
    assert_close(detected.pixels, true[::-1], atol=0.1)


def test_incomplete_and_missing_boards_are_distinguished() -> None:
    image = draw_board(BOARD, *view(BOARD, 0.35, (0.0, 0.3, 0.0)))
    image[:, :280] = 120
    piece, nothing = detect_checkerboard(image, BOARD), detect_checkerboard(np.zeros_like(image), BOARD)
    assert isinstance(piece, NoBoard)
    assert isinstance(nothing, NoBoard)
    assert (piece.found_size, nothing.found_size) == ((4, 3), None)


def test_edges_without_contrast_have_no_blur_and_are_not_moved() -> None:
    ends = np.array([[[100.0, 100.0], [150.0, 110.0]]])
    profiles = EdgeProfiles.from_image(np.full((400, 640), 90, dtype=np.uint8), ends, 0.2)
    assert np.isnan(profiles.blur)
    assert_close(profiles.edge_positions, profiles.points)


@pytest.mark.parametrize("blur", [1.0, 2.5])
def test_the_blur_of_edges(blur: float) -> None:
    R, t = view(BOARD, 0.3, (0.4, 0.3, 0.0))
    ends = CAMERA.project(BOARD.corners @ R.T + t)[0][BOARD.edges]
    profiles = EdgeProfiles.from_image(
        draw_board(BOARD, R, t, blur=blur), ends, BOARD.relative_edge_clearance
    )
    assert_close(profiles.blur, np.hypot(blur, 0.5), rtol=0.05)
