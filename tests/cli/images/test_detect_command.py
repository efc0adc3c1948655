"""`pisigma detect`: from image files to a file of corners, and what it refuses."""

import csv
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from testing.board_images import CAMERA, cv2, draw_board, view
from testing.closeness import assert_close
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError, OutputError
from pisigma.measurement.camera.board import Board
from pisigma.robot import Robot

BOARD = Board("board", 4, 5, 0.03)
VIEWS = [view(BOARD, 0.33, (roll, 0.4, -0.3)) for roll in (0.0, 2.0, 0.1, 5.0)]
CAMERA_YAML = f"width: {CAMERA.width}\nheight: {CAMERA.height}\nfx: 500\nfy: 500\ncx: 320\ncy: 200\n"


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with other files and four images; the third shows a part of a board, and the fourth is blurred."""
    folder = tmp_path_factory.mktemp("images")
    (folder / "images").mkdir()
    for number, (R, t) in enumerate(VIEWS):
        image = draw_board(BOARD, R, t, blur=4.0 if number == 3 else 0.8)
        if number == 2:
            image[:, :280] = 120
        cv2.imwrite(str(folder / "images" / f"{number:02d}.png"), image)
    (folder / "board.yaml").write_text("rows: 4\ncolumns: 5\nsquare_mm: 30\n")
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    (folder / "joints.csv").write_text("image,q1_deg,q2_deg\n00.png,10,20\n01.png,30,40\n02.png,1,2\n")
    return folder


def options(files: Path, **others: str) -> tuple[object, ...]:
    named = {"board": "board.yaml", "camera": "camera.yaml"} | others
    return (files / "images", *(word for name, file in named.items() for word in (f"--{name}", files / file)))


def test_corners_with_joint_values_are_written(run, files, tmp_path):
    command = ("detect", *options(files, joints="joints.csv"), "--out", tmp_path / "corners.csv")
    result = run(*command, "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert (printed["rows"], printed["rms_px"] < 0.05) == (40, True)
    reasons = [image["left_out"] for image in printed["images"]]
    assert reasons[:2] == [None, None]
    assert all(reasons[2:])
    assert "3.8 px" in reasons[3]
    rows = list(csv.DictReader((tmp_path / "corners.csv").read_text().splitlines()))
    assert list(rows[0]) == ["image", "camera", "board", "corner", "u_px", "v_px", "q1_deg", "q2_deg"]
    assert {(row["camera"], row["board"]) for row in rows} == {("camera", "board")}
    assert [row["q2_deg"] for row in rows] == ["20"] * 20 + ["40"] * 20
    pixels = np.array([[float(row["u_px"]), float(row["v_px"])] for row in rows]).reshape(2, 20, 2)
    for (R, t), detected in zip(VIEWS, pixels, strict=False):
        assert_close(detected, CAMERA.project(BOARD.corners @ R.T + t)[0], atol=0.08)


def test_what_is_held_out_is_named(run, files, tmp_path):
    result = run("detect", *options(files), "--out", tmp_path / "corners.csv")
    assert_screen(result.stdout, "2 of 4 images", "image 02", "image 03", "2 warnings")
    whole = run("detect", *options(files), "--out", tmp_path / "corners.csv", "--verbose")
    assert_screen(whole.stdout, "40 corners", verbose=True)


def test_truncated_images_are_named_and_the_others_used(run, files, tmp_path):
    images = tmp_path / "images"
    images.mkdir()
    for name in ("00.png", "01.png"):
        (images / name).write_bytes((files / "images" / name).read_bytes())
    whole = (images / "01.png").read_bytes()
    (images / "02.png").write_bytes(whole[: len(whole) // 2])
    (images / "03.png").write_bytes(whole[:60])
    ok, jpeg = cv2.imencode(".jpg", cv2.imread(str(images / "01.png")))
    assert ok
    (images / "04.jpg").write_bytes(jpeg.tobytes()[: len(jpeg) * 9 // 10])
    command = ("detect", images, *options(files)[1:], "--out", tmp_path / "corners.csv")
    result = run(*command, "--page", tmp_path / "page.html", "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert printed["rows"] == 40
    reasons = [image["left_out"] for image in printed["images"]]
    assert [bool(reason) for reason in reasons] == [False, False, True, True, True]
    assert all("truncated" in reason for reason in reasons[2:])


def test_what_is_refused(refuses, files, tmp_path):
    out = ("--out", tmp_path / "corners.csv")
    (files / "even.yaml").write_text("rows: 4\ncolumns: 6\nsquare_mm: 30\n")
    (files / "other.yaml").write_text("rows: 6\ncolumns: 7\nsquare_mm: 30\n")
    (files / "large.yaml").write_text(CAMERA_YAML.replace("640", "1280"))
    refuses("detect", *options(files, board="even.yaml"), *out, error=MeasurementError, file="even.yaml")
    refuses("detect", *options(files, board="other.yaml"), *out, error=MeasurementError, value=4)
    refuses(
        "detect", *options(files, camera="large.yaml"), *out, error=MeasurementError, value="640 x 400 px"
    )
    no_image = ("detect", files / "board.yaml", *options(files)[1:])
    refuses(*no_image, *out, error=MeasurementError)
    (files / "00.txt").write_text("notes")
    beside = ("detect", files / "00.txt", *options(files))
    refuses(*beside, *out, error=MeasurementError)
    (files / "empty.png").touch()
    refuses("detect", files / "empty.png", *options(files)[1:], *out, error=MeasurementError)
    assert not (tmp_path / "corners.csv").exists()


def test_a_board_is_drawn_to_be_printed(run, refuses, files, tmp_path):
    command = ("detect", "--board", files / "board.yaml", "--print")
    result = run(*command, tmp_path / "board.pdf")
    assert result.exit_code == 0, result.output
    assert "A3" in result.stdout
    assert (tmp_path / "board.pdf").read_bytes().startswith(b"%PDF")
    refuses(*command, tmp_path / "board.png", error=OutputError, file="board.png", value=".png")
    assert run(*command[:-1]).exit_code == 2


def test_the_size_of_squares_is_stated_for_a_robot(run, files, tmp_path):
    command = (
        "detect",
        "--board",
        files / "board.yaml",
        "--print",
        tmp_path / "board.pdf",
        "--robot",
        "so101",
    )
    values = json.loads(run(*command, "--json").stdout)
    # the reach on both sides of the base covers the image, and a square is 25 px wide
    pixels_per_mm = values["image_height_px"] / (2e3 * Robot.load("so101").reach)
    assert values["smallest_square_mm"] * pixels_per_mm == pytest.approx(25)
    assert "smallest_square_mm" not in json.loads(run(*command[:-2], "--json").stdout)


def test_a_page_shows_every_image(run, files, tmp_path):
    page = tmp_path / "page.html"
    result = run("detect", *options(files), "--out", tmp_path / "corners.csv", "--page", page)
    assert result.exit_code == 0, result.output
    text = page.read_text()
    assert text.count("<figure data-name=") == 4
    assert "Left out: " in text
    assert "3.8 px" in text


def test_without_opencv_the_extra_is_named(refuses, files, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in list(sys.modules):
        if name.startswith(("pisigma.measurement.camera.detection", "pisigma.workflow.images")):
            monkeypatch.delitem(sys.modules, name)
    message = refuses("detect", *options(files), "--out", tmp_path / "corners.csv")
    assert 'pip install "pisigma[camera]"' in message
