"""Joint values of a file: those of the robot, with other columns ignored, or a refusal."""

import math

import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.csv.reading import read_joints
from pisigma.robot import Robot


@pytest.fixture
def file(tmp_path):
    def write(text: str):
        path = tmp_path / "q.csv"
        path.write_text(text)
        return path

    return write


def test_columns_come_in_any_order_and_unit(file):
    path = file(
        "status,q4_rad,q3_mm,q2_deg,q1_deg\nreached,0.5,-150,90,45\n# a remark\nreached,0,1e3,0,-180\n"
    )
    expected = [[math.pi / 4, math.pi / 2, -0.15, 0.5], [-math.pi, 0.0, 1.0, 0.0]]
    assert_close(read_joints(path, Robot.load("kiro3")), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("text", "line", "column", "value"),
    [
        ("q1_deg,q2_deg,q3_mm\n1,2,3\n", 1, None, "none"),
        ("q1_deg,q2_deg,q3_deg,q4_deg\n1,2,3,4\n", 1, None, "none"),
        ("q1_deg,q1_rad,q2_deg,q3_mm,q4_deg\n1,1,2,3,4\n", 1, None, "q1_deg and q1_rad"),
        ("q1_deg,q2_deg,q3_mm,q4_deg,q5_deg\n1,2,3,4,5\n", 1, "q5_deg", 5),
        ("q1_deg,q2_deg,q3_mm,q4_deg\n1,2,3,4\n1,,3,4\n", 3, "q2_deg", ""),
        ("q1_deg,q2_deg,q3_mm,q4_deg\n1,2,3,nan\n", 2, "q4_deg", "nan"),
        ("q1_deg,q2_deg,q3_mm,q4_deg\n1,2\n", 2, "q3_mm", ""),
        ("", None, None, None),
    ],
)
def test_faults_are_refused(file, text, line, column, value):
    path = file(text)
    with refused(MeasurementError, file=path, line=line, column=column, value=value):
        read_joints(path, Robot.load("kiro3"))


def test_the_columns_of_a_missing_joint_are_listed(file):
    with refused(MeasurementError, value="none") as caught:
        read_joints(file("q1_deg,q2_deg,q3_deg,q4_deg\n1,2,3,4\n"), Robot.load("kiro3"))
    assert all(name in caught.value.remedy for name in ("q3_mm", "q3_m"))
