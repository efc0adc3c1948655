"""Files of corners of several cameras, also with rows of other sensors, as measurements."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from testing.camera_cell import BOARD, CAMERA, camera_cell, corner_lines
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability
from pisigma.measurement.camera.corner_file import read_rows
from pisigma.measurement.conditions import approach_by_order
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.intrinsics import boards, without_stated_priors
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.simulation.camera.simulated_images import ImageNoise

EXACT = ImageNoise(0.0, Repeatability(0.0, 0.0))
BESIDE, HAND = replace(CAMERA, name="beside", is_fixed=True), replace(BOARD, name="hand")


def camera_files(
    folder: Path, cameras: tuple[Camera, ...] = (CAMERA,), boards: tuple[Board, ...] = (BOARD,)
) -> CameraFiles:
    """Write the files of cameras and boards."""
    paths: tuple[list[str], list[str]] = ([], [])
    for camera in cameras:
        paths[0].append(str(folder / f"{camera.name}.yaml"))
        Path(paths[0][-1]).write_text(yaml.safe_dump(asdict(camera)))
    for board in boards:
        paths[1].append(str(folder / f"{board.name}.yaml"))
        stated = {"name": board.name, "rows": board.rows, "columns": board.columns}
        Path(paths[1][-1]).write_text(yaml.safe_dump(stated | {"square_mm": board.square * 1e3}))
    return CameraFiles(tuple(paths[0]), tuple(paths[1]))


def with_columns(lines: list[str], **columns: str) -> list[str]:
    """Return lines with additional columns of constant values."""
    names, cells = ",".join(columns), ",".join(columns.values())
    return [f"{lines[0]},{names}", *(f"{line},{cells}" for line in lines[1:])]


@pytest.mark.parametrize("is_fixed", [False, True], ids=["flange", "fixed"])
def test_exact_corners_give_the_poses_of_the_target(tmp_path: Path, is_fixed: bool) -> None:
    cell = camera_cell(8, 0, EXACT, is_fixed)
    path = tmp_path / "corners.csv"
    path.write_text("\n".join(corner_lines(cell.images)) + "\n")
    rows = read_rows(path, cell.nominal, replace(camera_files(tmp_path), is_fixed=is_fixed))
    assert (rows.frame[0], rows.target[0]) == (("wrist", "board") if is_fixed else ("board", "wrist"))
    assert_close(rows.T, forward_kinematics(cell.true, cell.images.q), atol=1e-7)
    assert rows.place(1) == f"{path}, line {2 + len(cell.images.corner_numbers[0])}, image '0001'"
    assert torch.isfinite(approach_by_order(rows)[1:]).all()
    assert torch.isnan(approach_by_order(rows.select(torch.tensor([0, 2])))).all()
    rows.write_csv(tmp_path / "rows.csv", cell.nominal)
    again = Measurements.read_csv(tmp_path / "rows.csv", cell.nominal)
    assert again.kinds == {"pose", "corner"}
    assert again.image == rows.image


def test_a_model_that_names_neither_frame_nor_target_takes_images(tmp_path: Path) -> None:
    cell = camera_cell(3, 0, EXACT)
    (tmp_path / "corners.csv").write_text("\n".join(corner_lines(cell.images)) + "\n")
    rows = read_rows(tmp_path / "corners.csv", cell.nominal, camera_files(tmp_path))
    renamed = replace(rows, frame=("",) * 3, target=("",) * 3)
    assert boards(rows) == boards(renamed) == ("board",) * 3
    assert without_stated_priors(renamed, {}).rows == 3


def test_several_cameras_and_other_sensors_in_one_file(tmp_path: Path) -> None:
    wrist, fixed = camera_cell(3, 0, EXACT), camera_cell(2, 0, EXACT, True)
    lines = with_columns(corner_lines(wrist.images), camera="wrist", board="board", set="train", x_mm="")
    other = with_columns(corner_lines(fixed.images), camera="beside", board="hand", set="test", x_mm="")
    joints = ",".join("10" for _ in range(6))
    lines = [line + "," for line in [*lines, *other[1:]]]
    lines = [lines[0] + "y_mm,z_mm", *(f"{line}," for line in lines[1:]), f",,,,{joints},,,train,100,200,300"]
    path = tmp_path / "corners.csv"
    path.write_text("\n".join(lines) + "\n")
    rows = read_rows(path, wrist.nominal, camera_files(tmp_path, (CAMERA, BESIDE), (BOARD, HAND)))
    assert rows.frame == ("board",) * 3 + ("beside",) * 2 + ("",)
    assert rows.target == ("wrist",) * 3 + ("hand",) * 2 + ("",)
    assert rows.split == ("train",) * 3 + ("test",) * 2 + ("train",)
    assert_close(rows.T[:3], forward_kinematics(wrist.true, wrist.images.q), atol=1e-7)
    assert_close(rows.T[3:5], forward_kinematics(fixed.true, fixed.images.q), atol=1e-7)
    assert rows.position is not None
    assert_close(rows.position[5].numpy(), np.array([0.1, 0.2, 0.3]), atol=1e-15)
    assert rows.image == ("0000", "0001", "0002", "0000", "0001", "")


def test_rows_of_several_files_keep_their_names(tmp_path: Path) -> None:
    cell = camera_cell(3, 0, EXACT)
    corners, tracker = tmp_path / "corners.csv", tmp_path / "tracker.csv"
    corners.write_text("\n".join(corner_lines(cell.images)) + "\n")
    Measurements(cell.images.q[:2], cell.images.q[:2, :3]).write_csv(tracker, cell.nominal)
    rows = read_rows([corners, tracker], cell.nominal, camera_files(tmp_path))
    assert rows.file_names == "corners.csv + tracker.csv"
    assert rows.select(rows.is_measured("position")).place(1) == f"{tracker}, line 3"


def test_corners_are_weighted_by_their_deviations(tmp_path: Path) -> None:
    cell = camera_cell(2, 0, EXACT)
    lines = with_columns(corner_lines(cell.images), sigma_px="0.5")
    worse = lines[10].split(",")
    lines[10] = ",".join([*worse[:2], str(float(worse[2]) + 1.0), *worse[3:-1], "500"])
    path = tmp_path / "corners.csv"
    path.write_text("\n".join(lines) + "\n")
    rows = read_rows(path, cell.nominal, camera_files(tmp_path))
    assert_close(rows.T, forward_kinematics(cell.true, cell.images.q), atol=1e-7)


@pytest.mark.parametrize(
    ("change", "line", "column", "value"),
    [
        (lambda lines: [lines[0].replace("u_px", "u"), *lines[1:]], 1, "u_px", None),
        (lambda lines: lines[:1], 1, None, None),
        (lambda lines: lines[:5], 2, None, 4),
        (lambda lines: [*lines, lines[1]], 2, "corner", None),
        (lambda lines: [*lines, lines[1].replace("0000,0", "0000,54", 1)], 434, "corner", 54.0),
        (lambda lines: [*lines[:54], lines[54].rpartition(",")[0] + ",1.5"], 2, "image", "0000"),
        (lambda lines: [*lines[:9], lines[9].replace(",", ",x", 2), *lines[10:]], 10, "corner", "x8"),
        (
            lambda lines: [*lines[:9], lines[9].replace(",8,", ",8,nan", 1), *lines[10:]],
            10,
            "u_px",
            "nan798.034152",
        ),
        (
            lambda lines: [*lines[:9], lines[9].replace(",8,", ",8,9", 1), *lines[10:]],
            10,
            None,
            "u = 9798.03, v = 834.151 px",
        ),
        (lambda lines: [*lines, "0000,3"], 434, None, 2),
        (lambda lines: with_columns(lines, sigma_px="0"), 2, "sigma_px", 0.0),
        (lambda lines: with_columns(lines, camera="wirst"), 2, "camera", "wirst"),
    ],
)
def test_faulty_files_are_refused(tmp_path: Path, change, line: int, column: str | None, value) -> None:
    path = tmp_path / "corners.csv"
    path.write_text("\n".join(change(corner_lines(camera_cell(8, 0, EXACT).images))) + "\n")
    with refused(MeasurementError, file=path, line=line, column=column, value=value):
        read_rows(path, camera_cell(8, 0, EXACT).nominal, camera_files(tmp_path))


def test_cameras_have_to_fit_the_files(tmp_path: Path) -> None:
    cell = camera_cell(8, 0, EXACT)
    path = tmp_path / "corners.csv"
    path.write_text("\n".join(corner_lines(cell.images)) + "\n")
    two = camera_files(tmp_path, (CAMERA, BESIDE))
    with refused(MeasurementError, line=1, column="camera"):
        read_rows(path, cell.nominal, two)
    with refused(MeasurementError, line=1, value="corner,u_px,v_px"):
        read_rows(path, cell.nominal)
    with refused(MeasurementError, column="name", value="wrist"):
        read_rows(path, cell.nominal, replace(two, cameras=two.cameras[:1] * 2))
    large = camera_files(tmp_path, (replace(CAMERA, width=7680, height=4800),))
    with refused(MeasurementError, file=path, line=None) as caught:
        read_rows(path, cell.nominal, large)
    assert "7680 x 4800 px" in caught.value.expected
    Measurements(cell.images.q, cell.images.q[:, :3]).write_csv(tmp_path / "tracker.csv", cell.nominal)
    with refused(MeasurementError, file="tracker.csv", line=None):
        read_rows(tmp_path / "tracker.csv", cell.nominal, camera_files(tmp_path))
