"""ChArUco boards and AprilTags in rendered images, complete and partly visible."""

import numpy as np
import pytest
from testing.board_images import CAMERA, cv2, draw_board, view
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.detection.detected_board import (
    DetectedBoard,
    EdgeProfiles,
    NoBoard,
    edge_pixels,
)
from pisigma.measurement.camera.detection.detector import detect_board
from pisigma.measurement.camera.detection.markers import detect_apriltags, detect_charuco, dictionary_of

CHARUCO = Board("board", 3, 4, 0.03, "charuco", 0.021, "4x4_50")
TAGS = Board("board", 2, 3, 0.055, "apriltag", 0.04, "tag36h11")
CASES = [(CHARUCO, detect_charuco, 0.12), (TAGS, detect_apriltags, 0.3)]


@pytest.mark.parametrize(("board", "detect", "largest"), CASES, ids=["charuco", "apriltag"])
def test_corners_of_a_whole_board_and_of_a_piece(board, detect, largest) -> None:
    R, t = view(board, 0.3, (2.0, 0.4, -0.3))
    image, true = draw_board(board, R, t), CAMERA.project(board.corners @ R.T + t)[0]
    whole = detect(image, board)
    assert isinstance(whole, DetectedBoard)
    assert sorted(whole.corner_numbers.tolist()) == list(range(len(true)))
    assert_close(whole.pixels, true[whole.corner_numbers], atol=largest)
    assert_close(
        np.sqrt(np.square(whole.pixels - true[whole.corner_numbers]).mean()), 0.0, atol=largest / 2.5
    )
    profiles = EdgeProfiles.from_image(image, edge_pixels(whole, board), board.relative_edge_clearance)
    assert_close(profiles.blur, np.hypot(0.8, 0.4), rtol=0.25)
    t[0] -= 0.15  # so that a part of the board is outside
    piece, true = detect(draw_board(board, R, t), board), CAMERA.project(board.corners @ R.T + t)[0]
    assert isinstance(piece, DetectedBoard)
    assert 4 <= len(piece.corner_numbers) < len(true)
    assert_close(piece.pixels, true[piece.corner_numbers], atol=largest)


@pytest.mark.parametrize(("board", "detect"), [case[:2] for case in CASES], ids=["charuco", "apriltag"])
def test_an_image_without_markers(board, detect) -> None:
    nothing = detect(np.full((400, 640), 120, dtype=np.uint8), board)
    assert isinstance(nothing, NoBoard)
    assert not nothing.is_mirrored


@pytest.mark.parametrize("board", [CHARUCO, TAGS], ids=["charuco", "apriltag"])
def test_a_mirrored_image_is_recognised(board, tmp_path) -> None:
    image = draw_board(board, *view(board, 0.3, (2.0, 0.4, -0.3)))
    cv2.imwrite(str(tmp_path / "flipped.png"), image[:, ::-1])
    flipped = detect_board(tmp_path / "flipped.png", board, 3.0).board
    assert isinstance(flipped, NoBoard)
    assert flipped.is_mirrored


def test_a_dictionary_with_too_few_markers_is_refused() -> None:
    with refused(MeasurementError, option="dictionary", value="4x4_50 with 50"):
        dictionary_of(Board("board", 8, 11, 0.03, "charuco", 0.02, "4x4_50"))
