"""`pisigma camera`: from image files to a camera file and a page, and what it warns of."""

import json
from pathlib import Path

import numpy as np
import pytest
from testing.board_images import CAMERA, cv2, draw_board, view
from testing.closeness import assert_close
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera

BOARD = Board("board", 4, 4, 0.03)
"""Which end of it is which, intrinsics do not depend on."""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with six images, the last one empty, and a board."""
    folder = tmp_path_factory.mktemp("images")
    (folder / "images").mkdir()
    for number in range(5):
        roll, about_x, about_y = 0.9 * number, 0.5 * np.cos(1.3 * number), 0.5 * np.sin(1.3 * number)
        R, t = view(BOARD, 0.3, (roll, about_x, about_y))
        t[:2] += 0.05 * np.cos(2 * number), 0.03 * np.sin(2 * number)
        cv2.imwrite(str(folder / "images" / f"{number:02d}.png"), draw_board(BOARD, R, t))
    cv2.imwrite(str(folder / "images" / "05.png"), np.full((CAMERA.height, CAMERA.width), 90, np.uint8))
    (folder / "board.yaml").write_text("rows: 4\ncolumns: 4\nsquare_mm: 30\n")
    return folder


def test_a_camera_and_a_page_are_written(run, files, tmp_path):
    page, out = tmp_path / "page.html", tmp_path / "camera.yaml"
    command = ("camera", files / "images", "--board", files / "board.yaml", "--name", "wrist", "--out", out)
    result = run(*command, "--page", page, "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    camera = Camera.load(out)
    assert (camera.name, camera.width, camera.height) == ("wrist", 640, 400)
    assert camera.sigma is not None
    errors = (camera.intrinsics - CAMERA.intrinsics)[:4]
    assert_close(errors, np.zeros(4), atol=max(4 * max(camera.sigma[:4]), 1.0))
    assert [one["name"] for one in printed["intrinsics"]][:2] == ["fx", "fy"]
    assert printed["rms_px"] < 0.05
    assert any("upper left" in warning for warning in printed["warnings"])
    assert any("5 images" in warning for warning in printed["warnings"])
    text = page.read_text()
    assert text.count("<figure data-name=") == 6
    assert "Left out: " in text
    assert "http" not in text.replace("http://www.w3.org", "")


def test_people_read_a_table(run, files, tmp_path):
    out = tmp_path / "camera.yaml"
    four = sorted((files / "images").iterdir())[:4]
    result = run("camera", *four, "--board", files / "board.yaml", "--out", out)
    assert_screen(result.stdout, "4 of 4 images", "standard deviation", "fx", "upper left", "4 images")
    assert str(out) in "".join(result.stdout.split())


def test_what_is_refused(refuses, files, tmp_path):
    board = ("--board", files / "board.yaml", "--out", tmp_path / "camera.yaml")
    two = [files / "images" / name for name in ("00.png", "01.png")]
    refuses("camera", *two, *board, error=MeasurementError)
    cv2.imwrite(str(tmp_path / "large.png"), np.zeros((500, 800), np.uint8))
    refuses(
        "camera",
        *two,
        tmp_path / "large.png",
        *board,
        error=MeasurementError,
        file="large.png",
        value="800 x 500 px",
    )
    assert not (tmp_path / "camera.yaml").exists()
