"""Boards to print: paper, true size, and corners found by a detector."""

import re

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.measurement.camera.board import Board, BoardDocument
from pisigma.reporting.board_sheet import board_pdf, draw_board_sheet

DPI = 100
MM = DPI / 25.4
"""[px]"""


@pytest.mark.parametrize(
    ("columns", "square", "paper", "size"),
    [
        (7, 20, "A4 or Letter", (210, 279.4)),
        (10, 20, "A4 or Letter landscape", (279.4, 210)),
        (11, 21, "A4 landscape", (297, 210)),
        (9, 30, "A3 landscape", (420, 297)),
    ],
)
def test_the_smallest_paper_is_taken(columns, square, paper, size) -> None:
    title, content = board_pdf(Board("board", 6, columns, square / 1e3))
    assert title == paper
    box = re.search(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]", content)
    assert box is not None
    assert_close([float(box[1]), float(box[2])], np.array(size) / 25.4 * 72, atol=0.1)


def test_no_paper_is_large_enough() -> None:
    with refused(OutputError, value="board"):
        board_pdf(Board("board", 30, 41, 0.03))


def test_corners_are_printed_at_their_true_distances() -> None:
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    assert cv2.__version__
    from pisigma.measurement.camera.detection.detected_board import DetectedBoard
    from pisigma.measurement.camera.detection.detector import DETECTORS

    charuco = Board("board", 4, 6, 0.025, "charuco", 0.018, "5x5_100")
    tags = Board("board", 3, 4, 0.04, "apriltag", 0.03, "tag36h11")
    for board in (Board("board", 6, 9, 0.02), charuco, tags):
        _, figure = draw_board_sheet(board)
        figure.set(dpi=DPI, facecolor="white")
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        detected = DETECTORS[board.kind](np.asarray(canvas.buffer_rgba())[..., 0].copy(), board)
        assert isinstance(detected, DetectedBoard)
        assert len(detected.corner_numbers) == len(board.corners)
        expected = board.corners[detected.corner_numbers, :2] * 1e3 * MM
        shift = (detected.pixels - expected).mean(0)
        assert_close(detected.pixels - shift, expected, atol=0.5)


def test_a_measured_ruler_does_not_change_what_is_printed() -> None:
    stated = BoardDocument(rows=6, columns=7, square_mm=20, ruler_mm=99.0)
    assert_close(stated.board().square, 0.0198, atol=1e-12)
    assert board_pdf(stated.board())[1] == board_pdf(Board("board", 6, 7, 0.02))[1]
