"""Joining of joint values and images by name and by time."""

from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.workflow.images.detect import join_joint_values


def log(folder: Path, text: str) -> Path:
    (folder / "joints.csv").write_text(text)
    return folder / "joints.csv"


def test_by_name_with_or_without_extension(tmp_path: Path) -> None:
    path = log(
        tmp_path, "image,q1_deg,q2_deg,payload_kg,note\na/0001.png,1.5,2,3,\n0002,4.25,5,3,\n0009,7,8,3,\n"
    )
    joined = join_joint_values(["0001", "0002", "0003"], path, 0.2)
    assert joined.columns == ("q1_deg", "q2_deg", "payload_kg")
    assert joined.texts_by_image == {"0001": ("1.5", "2", "3"), "0002": ("4.25", "5", "3")}
    assert "line 3 (0003)" in joined.remarks[0]
    assert "line 4 (0009)" in joined.remarks[1]
    assert "note" in joined.remarks[2]


def test_by_time_in_seconds_and_nanoseconds(tmp_path: Path) -> None:
    path = log(tmp_path, "time,q1_deg\n1700000000.0,1\n1700000001.0,2\n1700000005.0,3\n")
    joined = join_joint_values(["1700000001100000000", "1700000005.05", "1700000003.0"], path, 0.2)
    assert joined.texts_by_image == {"1700000001100000000": ("2",), "1700000005.05": ("3",)}


@pytest.mark.parametrize(
    ("text", "line", "column", "value"),
    [
        ("image,x_mm\n0001,1\n", 1, None, "image, x_mm"),
        ("q1_deg\n1\n", 1, None, "q1_deg"),
        ("image,q1_deg\n0001,one\n", 2, "q1_deg", "one"),
        ("image,q1_deg\n7,1\n", None, None, "0001 and 7"),
    ],
)
def test_invalid_logs_are_refused(
    tmp_path: Path, text: str, line: int | None, column: str | None, value: str
) -> None:
    with refused(MeasurementError, line=line, column=column, value=value):
        join_joint_values(["0001"], log(tmp_path, text), 0.2)
