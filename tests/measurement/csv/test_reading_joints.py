"""Joint values of a file: those of the robot, whatever else stands there, or a sentence."""

import math

import pytest
from testing.closeness import assert_close

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
    ("text", "complaint"),
    [
        (
            "q1_deg,q2_deg,q3_mm\n1,2,3\n",
            "line 1: there is no column for joint '.*' of robot 'kiro3'; give one, q4_deg",
        ),
        ("q1_deg,q2_deg,q3_deg,q4_deg\n1,2,3,4\n", "no column for joint '.*'; give one, q3_mm or q3_m"),
        ("q1_deg,q1_rad,q2_deg,q3_mm,q4_deg\n1,1,2,3,4\n", "there are two columns for joint"),
        (
            "q1_deg,q2_deg,q3_mm,q4_deg,q5_deg\n1,2,3,4,5\n",
            "column 'q5_deg': robot 'kiro3' has 4 joints only",
        ),
        (
            "q1_deg,q2_deg,q3_mm,q4_deg\n1,2,3,4\n1,,3,4\n",
            "line 3, column 'q2_deg': a number was wanted, got ''",
        ),
        (
            "q1_deg,q2_deg,q3_mm,q4_deg\n1,2,3,nan\n",
            "line 2, column 'q4_deg': a number was wanted, got 'nan'",
        ),
        ("q1_deg,q2_deg,q3_mm,q4_deg\n1,2\n", "line 2, column 'q3_mm'"),
        ("", "the file is empty"),
    ],
)
def test_what_is_no_joint_value_is_told(file, text, complaint):
    with pytest.raises(MeasurementError, match=complaint):
        read_joints(file(text), Robot.load("kiro3"))
