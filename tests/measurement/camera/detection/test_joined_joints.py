"""Joint values of images by their names and by their times."""

from pathlib import Path

import pytest

from pisigma.files.errors import MeasurementError
from pisigma.measurement.foreign.joining import join_joints


def log(folder: Path, text: str) -> Path:
    (folder / "joints.csv").write_text(text)
    return folder / "joints.csv"


def test_by_name_with_ending_or_without(tmp_path: Path) -> None:
    path = log(
        tmp_path, "image,q1_deg,q2_deg,payload_kg,note\na/0001.png,1.5,2,3,\n0002,4.25,5,3,\n0009,7,8,3,\n"
    )
    joined = join_joints(["0001", "0002", "0003"], path, 0.2)
    assert joined.columns == ("q1_deg", "q2_deg", "payload_kg")
    assert joined.cells == {"0001": ("1.5", "2", "3"), "0002": ("4.25", "5", "3")}
    assert "line 3 (0003)" in joined.remarks[0]
    assert "line 4 (0009)" in joined.remarks[1]
    assert "note are left out" in joined.remarks[2]


def test_by_time_in_seconds_and_nanoseconds(tmp_path: Path) -> None:
    path = log(tmp_path, "time,q1_deg\n1700000000.0,1\n1700000001.0,2\n1700000005.0,3\n")
    joined = join_joints(["1700000001100000000", "1700000005.05", "1700000003.0"], path, 0.2)
    assert joined.cells == {"1700000001100000000": ("2",), "1700000005.05": ("3",)}


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("image,x_mm\n0001,1\n", "joint values"),
        ("q1_deg\n1\n", "a column 'image' or 'time'"),
        ("image,q1_deg\n0001,one\n", "line 2, column 'q1_deg': a number was wanted, got 'one'"),
        ("image,q1_deg\n7,1\n", "no point has the same name"),
    ],
)
def test_what_cannot_be_joined_is_refused(tmp_path: Path, text: str, wanted: str) -> None:
    with pytest.raises(MeasurementError) as refused:
        join_joints(["0001"], log(tmp_path, text), 0.2)
    assert wanted in str(refused.value)
