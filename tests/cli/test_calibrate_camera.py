"""`pisigma calibrate`, `evaluate` and `recalibrate` with the corners of a board in a camera's images."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from click.testing import Result
from testing.camera_cell import BOARD, CAMERA, aligned_error, camera_cell, corner_lines
from testing.closeness import assert_close

from pisigma.files.errors import IdentificationError, MeasurementError, OutputError, PisigmaError
from pisigma.model.folder.model_folder import load_model
from pisigma.robot.kinematics.forward import forward_kinematics


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with corners.csv, camera.yaml and board.yaml."""
    folder = tmp_path_factory.mktemp("camera")
    (folder / "corners.csv").write_text("\n".join(corner_lines(camera_cell(50, 1).images)) + "\n")
    numbers = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "width", "height", "name")
    (folder / "camera.yaml").write_text("".join(f"{name}: {getattr(CAMERA, name)}\n" for name in numbers))
    (folder / "board.yaml").write_text(f"rows: 6\ncolumns: 9\nsquare_mm: {BOARD.square * 1e3}\n")
    return folder


def cameras(files: Path) -> tuple[object, ...]:
    return ("--camera", files / "camera.yaml", "--board", files / "board.yaml")


@pytest.fixture(scope="module")
def calibrated(run, files: Path) -> tuple[Path, Result]:
    """A model by corners.csv, and what the command printed."""
    command = ("calibrate", "ur5", files / "corners.csv", *cameras(files), "--set", "prior_mrad=5")
    result = run(*command, "--folds", 2, "--set", "repeats=1", "--out", files / "arm", "--json")
    assert result.exit_code == 0, result.output
    return files / "arm", result


def test_from_pixels_of_corners_to_a_model(calibrated):
    folder, result = calibrated
    printed = json.loads(result.stdout)
    (noise,) = printed["noise"]
    assert noise["sensor"] == "corner"
    figures = printed["cross_validation"]
    assert (figures["rows"], figures["folds"]) == (50, 2)  # a row an image
    assert figures["geometric"]["rms_mm"] < 1.0 < 2.0 < figures["nominal"]["rms_mm"]  # of one image: 0.5 mm
    assert any("board" in warning for warning in printed["warnings"])
    assert {"tool_not_identified", "camera_limits"} <= {one.get("cause") for one in printed["diagnostics"]}
    fx = next(one for one in printed["parameters"] if one["name"] == "camera_wrist_fx")
    assert fx["unit"] == "px"
    assert 0.1 < fx["standard_error"] < 0.4  # a usual calibration leaves 0.5 px
    assert 0.85 < figures["coverage"] <= 1.0
    card = (folder / "README.md").read_text()
    assert "pisigma calibrate ur5 corners.csv" in card
    assert "--camera camera.yaml --board board.yaml" in card
    model, q = load_model(folder), camera_cell(50, 2).images.q
    assert model.uncertainty is not None
    assert [group.name for group in model.uncertainty.space.unknowns] == ["camera", "board"]
    true, estimated = (
        forward_kinematics(robot, q)[:, :3, 3] for robot in (camera_cell(50, 1).true, model.calibrated)
    )
    assert_close(aligned_error(true, estimated), 0.0, atol=1e-4)


def test_new_corners_evaluate_and_update_a_model(run, refuses, files, calibrated):
    (files / "new.csv").write_text("\n".join(corner_lines(camera_cell(20, 1).images)) + "\n")
    judged = run("evaluate", calibrated[0], files / "new.csv", *cameras(files), "--json")
    assert judged.exit_code == 0, judged.output
    nominal, model = json.loads(judged.stdout)["models"]
    assert model["rms_mm"] < 0.6 < 2.0 < nominal["rms_mm"]
    added = run("recalibrate", calibrated[0], files / "new.csv", *cameras(files), "--dry-run", "--json")
    assert added.exit_code == 0, added.output
    assert json.loads(added.stdout)["left_out"] == 20
    refuses("verify", calibrated[0], files / "new.csv", error=MeasurementError, file="new.csv", line=1)


def test_corners_show_whether_a_model_still_holds(run, files, calibrated):
    """The zero of joint 3 has moved by 0.05 deg, 0.3 mm at the camera: less than the noise of the images' poses."""
    cell = camera_cell(20, 1)
    q = cell.images.q - torch.tensor([0.0, 0.0, np.deg2rad(0.05), 0.0, 0.0, 0.0])
    (files / "later.csv").write_text("\n".join(corner_lines(replace(cell.images, q=q))) + "\n")
    (files / "small.yaml").write_text("rows: 6\ncolumns: 9\nsquare_mm: 25\n")
    small = (*cameras(files)[:3], files / "small.yaml")
    wrong = json.loads(run("verify", calibrated[0], files / "new.csv", *small, "--json").stdout)
    assert any("1.2" in one["sentence"] for one in wrong["setup_faults"])
    moved = run("verify", calibrated[0], files / "later.csv", *cameras(files))
    assert moved.exit_code == 3
    said = " ".join(moved.stdout.split())
    assert re.search(r"oint 3 has moved by 0\.0(49|50)\d* ± 0\.005\d* deg", said)
    assert re.search(r"0\.\d+ mm RMS", said)
    assert f"--camera {files / 'camera.yaml'} --board {files / 'board.yaml'} --out DIR" in said
    turned = run("monitor", calibrated[0], files / "new.csv", *cameras(files), "--fixed-camera")
    assert turned.exit_code == 2
    assert "--fixed-camera" in turned.stderr
    sessions = (files / "new.csv", files / "later.csv", "--dates", "2026-01-01,2026-02-01")
    monitored = run("monitor", calibrated[0], *sessions, *cameras(files), "--no-history", "--json")
    assert monitored.exit_code == 3, monitored.output
    result = json.loads(monitored.stdout)
    assert [(one["verdict"], one["recalibrate"]) for one in result["sessions"]] == [
        ("unchanged", False),
        ("moved", True),
    ]
    assert any("--camera" in sentence for sentence in result["summary"])


def test_corners_are_compared_for_two_models_and_reported(run, refuses, files, calibrated):
    rows = files / "corners.csv"
    compared = run("compare", calibrated[0], "nominal", "--rows", rows, *cameras(files), "--json")
    assert compared.exit_code == 0, compared.output
    assert json.loads(compared.stdout)["rows"]["better"] == "arm"
    page = files / "camera.html"
    page.write_bytes((files / "camera.yaml").read_bytes())
    over = ("--camera", page, "--board", files / "board.yaml", "--out", page)
    refuses("report", calibrated[0], rows, *over, error=OutputError, file="camera.html")


def test_camera_and_board_belong_together(refuses, files, tmp_path):
    command = ("calibrate", "ur5", files / "corners.csv", "--camera", files / "camera.yaml")
    refuses(*command, "--out", tmp_path / "arm", error=PisigmaError, option="--board")
    assert not (tmp_path / "arm").exists()


def test_three_images_are_too_few(refuses, files, tmp_path):
    few = tmp_path / "few.csv"
    few.write_text("\n".join(corner_lines(camera_cell(20, 1).images)[: 1 + 3 * len(BOARD.corners)]) + "\n")
    command = ("calibrate", "ur5", few, *cameras(files), "--out", tmp_path / "arm")
    refuses(*command, error=MeasurementError, file="few.csv", value=3)


def test_a_file_does_not_count_twice(run, refuses, files, tmp_path):
    twice = files / "corners.csv", files / "corners.csv"
    refuses("calibrate", "ur5", *twice, *cameras(files), "--out", tmp_path / "arm", error=MeasurementError)
    copy = tmp_path / "copy.csv"
    copy.write_bytes((files / "corners.csv").read_bytes())
    command = ("calibrate", "ur5", files / "corners.csv", copy, *cameras(files), "--folds", 0)
    result = run(*command, "--model", "geometric", "--out", tmp_path / "arm")
    assert f"{copy}, line" in " ".join(result.stdout.split())


def test_intrinsics_are_one_of_three_choices(refuses, files, tmp_path):
    command = ("calibrate", "ur5", files / "corners.csv", *cameras(files), "--set", "intrinsics=loose")
    assert "fixed, free, prior" in refuses(*command, "--out", tmp_path / "arm", error=IdentificationError)
    assert not (tmp_path / "arm").exists()


def test_options_of_cameras_are_refused_without_one(run, files, tmp_path):
    command = ("calibrate", "ur5", files / "corners.csv", "--fixed-camera", "--set", "repeatability_mm=0.1")
    result = run(*command, "--out", tmp_path / "arm")
    assert result.exit_code == 2
    for option in ("--fixed-camera", "--set repeatability_mm", "--camera", "--board"):
        assert option in result.stderr


def test_corners_without_a_camera_are_no_export_to_import(run, files, tmp_path):
    path = tmp_path / "corners.csv"
    header, *rows = (files / "corners.csv").read_text().splitlines()
    path.write_text("\n".join([f"{header},camera", *(f"{row},camera" for row in rows)]) + "\n")
    result = run("calibrate", "ur5", path, "--out", tmp_path / "arm")
    assert result.exit_code == 2
    assert "pisigma import" not in " ".join(result.stderr.split())
