"""Boards of three kinds: files, positions of corners, and symmetry."""

from pathlib import Path

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board import Board

CHARUCO = "kind: charuco\nrows: 4\ncolumns: 5\nsquare_mm: 30\nmarker_mm: 22\ndictionary: 4x4_100\n"
TAGS = "kind: apriltag\nrows: 3\ncolumns: 4\ntag_mm: 30\nspacing_mm: 9\n"


def loaded(folder: Path, text: str) -> Board:
    (folder / "board.yaml").write_text(text)
    return Board.load(folder / "board.yaml")


def test_files_of_three_kinds(tmp_path: Path) -> None:
    plain = loaded(tmp_path, "rows: 6\ncolumns: 9\nsquare_mm: 30\n")
    assert plain == Board("board", 6, 9, 0.03)
    bent = loaded(tmp_path, "rows: 6\ncolumns: 9\nsquare_mm: 30\nflatness_mm: 0.3\n")
    assert_close(bent.flatness, 3e-4, atol=1e-12)
    charuco = loaded(tmp_path, CHARUCO)
    assert (charuco.kind, charuco.dictionary, charuco.square, charuco.marker) == (
        "charuco",
        "4x4_100",
        0.03,
        0.022,
    )
    tags = loaded(tmp_path, TAGS)
    assert (tags.kind, tags.dictionary, tags.square, tags.marker) == ("apriltag", "tag36h11", 0.039, 0.03)


@pytest.mark.parametrize(
    ("text", "line", "column", "names"),
    [
        ("rows: 6\ncolumns: 9\n", 1, None, ["checkerboard", "square_mm", "none"]),
        (TAGS + "square_mm: 3\n", 1, None, ["apriltag", "tag_mm and spacing_mm", "square_mm, tag_mm"]),
        ("rows: 6\ncolumns: 9\nsquare_mm: 0.03\n", 3, "square_mm", []),
        (CHARUCO.replace("22", "31"), 1, None, ["marker_mm < square_mm", "31"]),
        (CHARUCO.replace("4x4_100", "4x4_99"), 6, "dictionary", ["'4x4_50'"]),
    ],
)
def test_invalid_boards_are_refused(
    tmp_path: Path, text: str, line: int, column: str | None, names: list[str]
) -> None:
    with refused(MeasurementError, file="board.yaml", line=line, column=column) as caught:
        loaded(tmp_path, text)
    assert all(name in str(caught.value) for name in names)


def test_corners_of_a_tag_are_numbered_clockwise(tmp_path: Path) -> None:
    corners = loaded(tmp_path, TAGS).corners
    assert corners.shape == (48, 3)
    assert_close(corners[20:24] * 1e3, [[39, 39, 0], [69, 39, 0], [69, 69, 0], [39, 69, 0]])  # of the sixth


def test_edges_join_neighbouring_corners(tmp_path: Path) -> None:
    for board, length in ((Board("board", 6, 9, 0.03), 0.03), (loaded(tmp_path, TAGS), 0.03)):
        ends = board.corners[board.edges]
        assert_close(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), np.full(len(ends), length), atol=1e-12)


def test_a_checkerboard_of_an_even_sum_of_rows_and_columns_is_symmetric(tmp_path: Path) -> None:
    assert not Board("board", 6, 9, 0.03).is_symmetric
    assert Board("board", 6, 8, 0.03).is_symmetric
    assert not loaded(tmp_path, CHARUCO).is_symmetric
