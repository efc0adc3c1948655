"""Files of desired poses: units from the names, and faults with file, line and column."""

import os

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files import input_file
from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.poses import read_pose_chunks, read_poses
from pisigma.robot.se3 import transform_from_xyz_zyx

RPY = "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg"
QUATERNION = "x_m,y_m,z_m,qx,qy,qz,qw"


def read(tmp_path, *lines: str):
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n")
    return read_poses(path)


def test_roll_pitch_yaw_in_degrees_and_millimetres(tmp_path):
    found = read(tmp_path, "# wanted", RPY, "100,-200,300,10,20,30", "", " 1e2 ,0,+5,0,0,-90")
    values = torch.tensor([[0.1, -0.2, 0.3, 10, 20, 30], [0.1, 0, 0.005, 0, 0, -90]], dtype=torch.float64)
    values[:, 3:] = torch.deg2rad(values[:, 3:])
    assert_close(found.T, transform_from_xyz_zyx(values), atol=1e-15)
    assert found.line == (3, 5)


def test_quaternions_metres_and_any_order_of_columns(tmp_path):
    half = 0.5**0.5
    found = read(tmp_path, QUATERNION, f"0.1,0.2,0.3,0,0,{half},{half}")
    quarter = transform_from_xyz_zyx(torch.tensor([[0.1, 0.2, 0.3, torch.pi / 2, 0, 0]], dtype=torch.float64))
    assert_close(found.T, quarter, atol=1e-15)
    mixed = read(tmp_path, "yaw_deg,z_mm,x_mm,roll_deg,y_mm,pitch_deg", "0,300,100,90,200,0")
    assert_close(mixed.T, quarter, atol=1e-15)


@pytest.mark.parametrize(
    ("lines", "line", "column", "value"),
    [
        (["x_mm,y_mm,z_mm,roll_deg,pitch_deg", "1,2,3,4,5"], 1, None, "yaw"),
        (["x_mm,y_mm,z_mm", "1,2,3"], 1, None, "roll"),
        (["x_mm,y_mm,z_mm,qx,qy,qz", "1,2,3,0,0,0"], 1, None, "qw"),
        ([f"{RPY},colour", "1,2,3,4,5,6,7"], 1, "colour", "colour"),
        (
            [RPY.replace(",", ";"), "1;2;3;4;5;6"],
            1,
            "x_mm;y_mm;z_mm;roll_deg;pitch_deg;yaw_deg",
            "semicolons",
        ),
        ([f"{RPY},q1_deg", "1,2,3,4,5,6,7"], 1, "q1_deg", "q1_deg"),
        ([RPY.replace("roll_deg", "rol_deg"), "1,2,3,4,5,6"], 1, "rol_deg", "rol_deg"),
        ([f"{RPY},x_m", "1,2,3,4,5,6,7"], 1, "x_m", None),
        ([f"{RPY},qx,qy,qz,qw", "1,2,3,4,5,6,0,0,0,1"], 1, None, "both"),
        ([RPY.replace("y_mm", "y_m"), "1,2,3,4,5,6"], 1, None, "mm, m, mm"),
        ([RPY, "1,2,3,4,5,6", "1,2,3,4,5"], 3, None, 5),
        ([RPY, "1,5,2,3,4,5,6"], 2, None, 7),
        ([RPY, '1,2,3,4,5,"6'], 2, None, None),
        ([RPY, "1,2,three,4,5,6"], 2, "z_mm", "three"),
        ([RPY, "1,2,nan,4,5,6"], 2, "z_mm", "nan"),
        ([RPY, "1,2,3,4,5,inf"], 2, "yaw_deg", "inf"),
        ([RPY, "1,2,3,1e300,5,6"], 2, "roll_deg", "1e300"),
        ([RPY, "1,2,3,4,5,6", "#REF!,2,3,4,5,6"], 3, "x_mm", "#REF!"),
        ([RPY, "1,2,,4,5,6"], 2, "z_mm", ""),
        ([RPY, "1,2,1_000,4,5,6"], 2, "z_mm", "1_000"),
        ([QUATERNION, "0,0,0,0,0,0,1", "0,0,0,0,0,0,2"], 3, "qx", 2.0),
        ([QUATERNION, "0,0,0,0,0,0,0"], 2, "qx", 0.0),
        ([RPY], 1, None, None),
        ([], None, None, None),
    ],
)
def test_faults_are_refused(tmp_path, lines, line, column, value):
    path = tmp_path / "poses.csv"
    with refused(MeasurementError, file=path, line=line, column=column, value=value) as caught:
        read(tmp_path, *lines)
    assert "\n" not in str(caught.value)


def test_a_misspelt_column_gets_the_nearest_one(tmp_path):
    with refused(MeasurementError, column="rol_deg") as caught:
        read(tmp_path, RPY.replace("roll_deg", "rol_deg"), "1,2,3,4,5,6")
    assert "'roll_deg'" in caught.value.remedy


def test_files_that_cannot_be_read(tmp_path):
    with refused(MeasurementError, file=tmp_path / "nothing.csv", line=None):
        read_poses(tmp_path / "nothing.csv")
    (tmp_path / "poses.csv").write_bytes(b"\xff\xfe\x00x")
    with refused(MeasurementError, line=1, expected="UTF-8 text"):
        read_poses(tmp_path / "poses.csv")


HALF = 0.5**0.5
ROWS = [
    "0.1,0.2,0.3,0,0,0,1",
    "",
    f"0.4,0.5,0.6,0,0,{HALF},{HALF}",
    "0.1,0.2,0.3,0,0,0,2",
    "# a remark",
    "0.1,0.2,0.3,0,0,0",
    "0.7,0.8,0.9,1,0,0,0",
    "0.1,two,0.3,0,0,0,1",
    "0.2,0.3,0.4,0,1,0,0",
]
SOUND, BAD = (2, 4, 8, 10), (5, 7, 9)


@pytest.mark.parametrize("rows", [1, 2, 3, 100])
def test_chunks_contain_every_row_once_and_in_order(tmp_path, rows):
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([QUATERNION, *ROWS]) + "\n")
    chunks = list(read_pose_chunks(path, rows))
    assert all(len(chunk.line) + len(chunk.invalid_rows) <= rows for chunk in chunks)
    assert [line for chunk in chunks for line in chunk.line] == list(SOUND)
    assert [bad.line for chunk in chunks for bad in chunk.invalid_rows] == list(BAD)
    only_sound = read(tmp_path, QUATERNION, *(ROWS[line - 2] for line in SOUND))
    assert_close(torch.cat([chunk.T for chunk in chunks]), only_sound.T, atol=0.0)
    shares = [chunk.read_fraction for chunk in chunks]
    assert shares == sorted(shares)
    assert shares[-1] == 1


def test_chunks_state_the_fault_of_a_row(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_bytes("\n".join([QUATERNION, *ROWS, "0,0,0,0,0,0,ü", ""]).encode("latin-1"))
    (chunk,) = read_pose_chunks(path)
    faults = [(bad.line, bad.fault.column, bad.fault.value) for bad in chunk.invalid_rows]
    assert faults == [(5, "qx", 2.0), (7, None, 6), (9, "y_m", "two"), (11, None, None)]
    assert chunk.invalid_rows[3].fault.expected == "UTF-8 text"


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ends_of_lines_and_byte_order_marks(tmp_path, end):
    path = tmp_path / "poses.csv"
    path.write_bytes(("\ufeff" + end.join([QUATERNION, *ROWS[:3]])).encode())
    (chunk,) = read_pose_chunks(path)
    assert chunk.line == (2, 4)
    assert not chunk.invalid_rows


def test_a_long_cell_is_cut(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text(f"{QUATERNION}\n{'x' * 100_000},0,0,0,0,0,1\n")
    (chunk,) = read_pose_chunks(path)
    assert len(chunk.invalid_rows[0].reason) < 200


def test_a_file_without_lines_or_a_silent_pipe_is_refused(tmp_path, monkeypatch):
    with refused(MeasurementError, file="/dev/zero", line=1):
        read_poses("/dev/zero")
    monkeypatch.setattr(input_file, "MAX_WAIT_S", 0.05)
    os.mkfifo(tmp_path / "pipe")
    with refused(MeasurementError, file=tmp_path / "pipe", line=None):
        read_poses(tmp_path / "pipe")
