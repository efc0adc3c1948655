"""Files with touches, sockets and distances: reading, reading back, and faults."""

from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

MIXED = """\
q1_deg,x_mm,y_mm,z_mm,socket,touch_axis,touch_mm,distance_mm,anchor,anchor_x_mm,anchor_y_mm,anchor_z_mm,pair,frame,sigma_mm
1,1,2,3,,,,,,,,,,tracker,0.1
2,,,,a/0,,,,,,,,,,
3,,,,a/0,,,,,,,,,,
4,,,,,z,-120.5,,,,,,,left,0.2
5,,,,,,,812.25,wire,100,0,-5,,,0.1
6,,,,,,,300,,,,,bar 1,,0.05
7,,,,,,,300,,,,,bar 1,,0.05
8,,,,,,,0,rope,,,,,,
"""


def read(tmp_path: Path, text: str, on_bad_row: str = "error") -> Measurements:
    path = tmp_path / "data.csv"
    path.write_text(text)
    return Measurements.read_csv(path, on_bad_row=on_bad_row)


def test_a_file_contains_several_kinds_and_frames(tmp_path: Path):
    data = read(tmp_path, MIXED)
    assert data.kinds == {"position", "socket", "touch", "distance"}
    assert data.is_measured("position").tolist() == [True] + [False] * 7
    assert data.is_measured("socket").nonzero()[:, 0].tolist() == [1, 2]
    assert data.is_measured("touch").nonzero()[:, 0].tolist() == [3]
    assert data.is_measured("distance").nonzero()[:, 0].tolist() == [4, 5, 6, 7]
    assert data.socket == ("", "a/0", "a/0", "", "", "", "", "")
    assert (data.touch_axis[3], data.frame[3], data.anchor[4], data.pair[5:7]) == (
        "z",
        "left",
        "wire",
        ("bar 1",) * 2,
    )
    assert_close(data.touch[3], -0.1205, atol=1e-16)
    assert_close(data.distance[4:], [0.81225, 0.3, 0.3, 0.0], atol=1e-16)
    assert_close(data.anchor_place[4], [0.1, 0.0, -0.005], atol=1e-16)
    assert data.anchor_place[[0, 5, 7]].isnan().all()
    assert_close(data.sigma_position[[0, 3]], [1e-4, 2e-4], atol=1e-18)


@pytest.mark.parametrize("rows", [[0, 1, 3], [1, 2], [3], [4, 7], [5, 6], list(range(8))])
def test_written_files_read_back(tmp_path: Path, rows: list[int]):
    data = read(tmp_path, MIXED).select(torch.tensor(rows))
    data.write_csv(tmp_path / "again.csv")
    again = Measurements.read_csv(tmp_path / "again.csv")
    for item in fields(Measurements):
        actual, expected = getattr(again, item.name), getattr(data, item.name)
        if item.name in ("line", "source", "left_out"):
            continue
        if isinstance(expected, torch.Tensor) and expected.isnan().all():
            assert actual is None, item.name
        elif isinstance(expected, torch.Tensor):
            assert torch.equal(actual.isnan(), expected.isnan())
            assert_close(actual.nan_to_num(), expected.nan_to_num(), atol=1e-15, rtol=1e-14)
        else:
            assert actual == expected, item.name
    assert again.kinds == data.kinds


def test_metres_are_read_too(tmp_path: Path):
    data = read(
        tmp_path,
        "q1_rad,frame,touch_axis,touch_m,distance_m,anchor,anchor_x_m,anchor_y_m,anchor_z_m\n"
        "0,left,x,0.5,,,,,\n0,,,,2,wire,1,2,3\n",
    )
    assert_close(data.touch[0], 0.5)
    assert_close(data.distance[1], 2.0)
    assert_close(data.anchor_place[1], [1.0, 2.0, 3.0])


def test_measured_sockets(shared_data: Path, tmp_path: Path):
    robot = Robot.load("panda")
    data = Measurements.read_csv(shared_data / "panda_sockets" / "panda_3.csv", robot)
    assert (data.rows, data.dof, data.kinds) == (387, 7, {"socket"})
    assert len(set(data.socket)) == 12
    assert {name.rpartition("/")[2] for name in data.socket} == {"0", "1"}
    assert data.position is None
    data.write_csv(tmp_path / "again.csv", robot)
    again = Measurements.read_csv(tmp_path / "again.csv", robot)
    assert again.socket == data.socket
    assert_close(again.q, data.q, atol=1e-14)


TOUCH = "q1_deg,frame,touch_axis,touch_mm"
WIRE = "q1_deg,distance_mm,anchor,anchor_x_mm,anchor_y_mm,anchor_z_mm,pair,frame,sigma_mm"
ALL = "q1_deg,x_mm,y_mm,z_mm,socket,frame,touch_axis,touch_mm,distance_mm,anchor"
# name: (content, (line, column, value, *names that the remedy lists))
CASES: dict[str, tuple[str, tuple[object, ...]]] = {
    "no axis": (f"{TOUCH}\n1,left,w,3\n", (2, "touch_axis", "w")),
    "capital axis": (f"{TOUCH}\n1,left,X,3\n", (2, "touch_axis", "X")),
    "touch without axis": (f"{TOUCH}\n1,left,,3\n", (2, "touch_axis", "")),
    "axis without touch": (f"{TOUCH}\n1,left,y,\n", (2, "touch_mm", None)),
    "touch without frame": (f"{TOUCH}\n1,,y,3\n", (2, "frame", "")),
    "no axis column": ("q1_deg,frame,touch_mm\n1,left,3\n", (1, "touch_mm", None, "touch_axis")),
    "no touch column": ("q1_deg,frame,touch_axis\n1,left,x\n", (1, "touch_axis", None, "touch_mm")),
    "no frame column": ("q1_deg,touch_axis,touch_mm\n1,x,3\n", (1, "touch_mm", None, "frame")),
    "distance from nowhere": (f"{WIRE}\n1,3,,,,,,,\n", (2, "anchor", None)),
    "no anchor column": ("q1_deg,distance_mm\n1,3\n", (1, "distance_mm", None, "anchor", "pair")),
    "anchor without distance": (f"{WIRE}\n1,,wire,,,,,,\n", (2, "distance_mm", None)),
    "no distance column": ("q1_deg,pair\n1,a\n", (1, "pair", None, "distance_mm")),
    "anchor and pair": (f"{WIRE}\n1,3,wire,,,,bar,,\n", (2, "anchor", None)),
    "negative distance": (f"{WIRE}\n1,-3,wire,,,,,,\n", (2, "distance_mm", -3.0)),
    "half an anchor": (f"{WIRE}\n1,3,wire,1,,2,,,\n", (2, "anchor_x_mm", "2 of them")),
    "half an anchor in the header": (
        "q1_deg,distance_mm,anchor,anchor_x_mm\n1,3,w,1\n",
        (1, "anchor_x_mm", None, "anchor_y_mm", "anchor_z_mm"),
    ),
    "anchor in two units": (
        "q1_deg,distance_mm,anchor,anchor_x_mm,anchor_y_m,anchor_z_mm\n1,3,w,1,2,3\n",
        (1, "anchor_y_m", "m"),
    ),
    "place of no anchor": (f"{WIRE}\n1,3,,1,2,3,bar,,\n2,3,,,,,bar,,\n", (2, "anchor", None)),
    "anchor in two places": (f"{WIRE}\n1,3,wire,1,2,3,,,\n2,3,wire,1,2,4,,,\n", (2, "anchor_x_mm", "wire")),
    "anchor known in one row": (f"{WIRE}\n1,3,wire,1,2,3,,,\n2,3,wire,,,,,,\n", (2, "anchor_x_mm", "wire")),
    "anchor in two frames": (f"{WIRE}\n1,3,wire,,,,,a,\n2,3,wire,,,,,b,\n", (2, "frame", "a")),
    "socket in two frames": ("q1_deg,socket,frame\n1,s,a\n2,s,b\n", (2, "frame", "a")),
    "pair of one": (f"{WIRE}\n1,3,,,,,bar,,\n", (2, "pair", "1 row")),
    "pair of three": (f"{WIRE}\n1,3,,,,,bar,,\n2,3,,,,,bar,,\n3,3,,,,,bar,,\n", (2, "pair", "3 rows")),
    "pair of two distances": (f"{WIRE}\n1,3,,,,,bar,,\n2,4,,,,,bar,,\n", (2, "pair", "3 and 4")),
    "pair of two sigmas": (f"{WIRE}\n1,3,,,,,bar,,1\n2,3,,,,,bar,,2\n", (2, "pair", "1 and 2")),
    "pair in two frames": (f"{WIRE}\n1,3,,,,,bar,a,\n2,3,,,,,bar,b,\n", (2, "pair", "'a' and 'b'")),
    "pair with a bad row": (f"{WIRE}\n1,3,,,,,bar,,\n2,3,,,,,bar,,0\n", (2, "pair", "bar")),
    "two lengths": (f"{ALL}\n1,1,2,3,s,,,,,\n", (2, "x_mm", "x_mm and socket")),
    "touch and distance": (f"{ALL}\n1,,,,,left,x,2,3,w\n", (2, "touch_mm", "touch_mm and distance_mm")),
    "nothing": (f"{ALL}\n1,,,,,left,,,,\n", (2, None, None, "socket", "touch_mm")),
    "no socket": ("q1_deg,socket\n1,a\n2,\n", (3, None, None, "socket")),
    "no number": (f"{TOUCH}\n1,left,x,here\n", (2, "touch_mm", "here")),
    "touch of zero sigma": (f"{TOUCH},sigma_mm\n1,left,x,1,0\n", (2, "sigma_mm", 0.0)),
    "misspelt": ("q1_deg,sokket\n1,a\n", (1, "sokket", "sokket", "socket")),
    "part of a position": ("q1_deg,x_mm,socket\n1,2,a\n", (1, "y_mm", None, "x_mm,y_mm,z_mm")),
}


@pytest.mark.parametrize("case", CASES)
def test_faults_are_refused(tmp_path: Path, case: str):
    text, (line, column, value, *names) = CASES[case]
    path = tmp_path / "data.csv"
    with refused(MeasurementError, file=path, line=line, column=column, value=value) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert all(str(name) in caught.value.remedy for name in names)


def test_both_rows_of_a_pair_are_left_out(tmp_path: Path):
    text = f"{WIRE}\n1,3,,,,,bar,,\n2,3,,,,,bar,,0\n3,5,,,,,rod,,\n4,5,,,,,rod,,\n"
    data = read(tmp_path, text, "leave_out")
    assert data.pair == ("rod", "rod")
    assert [left.line for left in data.left_out] == [2, 3]
    assert [left.fault.column for left in data.left_out] == ["pair", "sigma_mm"]
    assert "line 3" in data.left_out[0].reason


def test_refuses_to_write_a_row_without_a_measurement(tmp_path: Path):
    data = read(tmp_path, MIXED).select(torch.tensor([1, 3]))
    data = replace(data, socket=None)
    with refused(MeasurementError, line=3, column=None, value=None):
        data.write_csv(tmp_path / "again.csv")
