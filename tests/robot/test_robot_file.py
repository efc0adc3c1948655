"""Robot files are read in SI units, and mistakes are rejected with file, line and key."""

import dataclasses

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PoseError, RobotError, UnknownRobotError
from pisigma.files.yaml_file import parse_yaml
from pisigma.robot import Robot, RobotDocument, Row, catalogue
from pisigma.robot.writing import robot_to_yaml

TEXT = """\
name: arm
maker: nobody
source: made up
rows:
  - {name: theta_1, type: revolute, limits_deg: [-90, 180], theta_deg: 90, d_mm: 100, a_mm: 2, alpha_deg: -90}
  - {name: d_2, type: prismatic, direction: -1, limits_mm: [0, 300], beta_deg: 1.0e-2}
  - {name: flange, type: fixed, d_mm: 5}
base: {x_mm: 1, roll_deg: 90}
tool: {z_mm: 250, yaw_deg: -180}
"""


def read(text: str) -> Robot:
    return Robot(*parse_yaml(text, RobotDocument, RobotError, "arm.yaml").to_fields())


def test_units_and_columns():
    robot = read(TEXT)
    assert_close(robot.dh[0], [np.pi / 2, 0.1, 0.002, -np.pi / 2, 0], atol=1e-16)
    assert_close(robot.dh[1], [0, 0, 0, 0, np.deg2rad(0.01)], atol=1e-18)
    assert_close(robot.limits, [[-np.pi / 2, np.pi], [0, 0.3]], atol=1e-16)
    assert_close(robot.directions, [1, -1], atol=0)
    assert_close(robot.base, [0.001, 0, 0, np.pi / 2, 0, 0], atol=1e-16)
    assert_close(robot.tool, [0, 0, 0.25, 0, 0, -np.pi], atol=1e-16)
    assert (robot.dof, robot.joint_rows, robot.revolute) == (2, (0, 1), (True, False))
    assert_close(robot.reach, np.hypot(0.1, 0.002) + 0.005 + 0.25 + 0.3, rtol=1e-15)


@pytest.mark.parametrize("name", catalogue())
def test_every_robot_of_the_catalogue_is_restored_from_its_file(name):
    robot = Robot.load(name)
    assert robot.name == name
    assert robot.maker
    assert robot.source
    again = read(robot_to_yaml(robot))
    assert again.rows == tuple(
        dataclasses.replace(row, lower=b.lower, upper=b.upper)
        for row, b in zip(robot.rows, again.rows, strict=True)
    )
    for part in ("dh", "base", "tool", "limits"):
        assert_close(getattr(again, part), getattr(robot, part), atol=1e-15, rtol=1e-15)


@pytest.mark.parametrize(
    ("old", "new", "line", "column", "value"),
    [
        ("direction: -1", "direction: 2", 6, "rows.1.direction", 2),
        ("direction: -1", "direction: -1.5", 6, "rows.1.direction", -1.5),
        ("[-90, 180]", "[180, -90]", 5, "rows.0", (180, -90)),
        ("[-90, 180]", "[180, 180]", 5, "rows.0", (180, 180)),
        ("[-90, 180]", "[-90]", 5, "rows.0.limits_deg.1", None),
        ("[-90, 180]", "[-90, .inf]", 5, "rows.0.limits_deg.1", np.inf),
        ("limits_deg: [-90, 180]", "limits_mm: [0, 1]", 5, "rows.0", "limits_mm"),
        ("limits_mm: [0, 300]", "limits_deg: [0, 3]", 6, "rows.1", "limits_deg"),
        ("type: fixed", "type: fixed, limits_mm: [0, 3]", 7, "rows.2", "limits_mm"),
        ("d_mm: 100", "d_m: 0.1", 5, "rows.0.d_m", "d_m"),
        ("alpha_deg", "alpha_rad", 5, "rows.0.alpha_rad", "alpha_rad"),
        ("type: revolute", "type: revolut", 5, "rows.0.type", "revolut"),
        ("name: d_2", "name: theta_1", 1, None, "theta_1"),
        ("d_mm: 100", "d_mm: '100'", 5, "rows.0.d_mm", "100"),
        ("d_mm: 100", "d_mm: 1e300", 5, "rows.0.d_mm", 1e300),
        ("limits_mm: [0, 300]", "limits_mm: [0, 1e12]", 6, "rows.1.limits_mm.1", 1e12),
        ("d_mm: 100", "d_mm: yes", 5, "rows.0.d_mm", "yes"),
        ("maker: nobody\n", "", 1, "maker", None),
        ("name: theta_1, ", "", 5, "rows.0.name", None),
        ("x_mm: 1", "x_mm: .inf", 8, "base.x_mm", np.inf),
        ("base:", "bas:", 8, "bas", "bas"),
    ],
)  # fmt: skip
def test_mistakes_are_rejected_with_file_line_and_key(old, new, line, column, value):
    assert old in TEXT
    with refused(RobotError, file="arm.yaml", line=line, column=column, value=value) as caught:
        read(TEXT.replace(old, new, 1))
    assert "\n" not in str(caught.value)


def test_a_robot_needs_a_joint():
    start = TEXT[: TEXT.index("rows:")]
    with refused(RobotError, column="rows", expected="a value"):
        read(start)
    with refused(RobotError, line=4, column="rows"):
        read(start + "rows: []\n")
    with refused(RobotError, expected="a joint"):
        read(start + "rows: [{name: a, type: fixed}]\n")


def test_unknown_robots_are_rejected_with_the_nearest_name(tmp_path):
    with refused(UnknownRobotError, value="ur100") as caught:
        Robot.load("ur100")
    assert "'ur10'" in caught.value.remedy
    with refused(RobotError, file="none.yaml", value="No such file or directory"):
        Robot.load(tmp_path / "none.yaml")
    (tmp_path / "arm.yml").write_text(TEXT)
    assert Robot.load(tmp_path / "arm.yml").name == "arm"


def test_a_single_limit_cannot_be_written():
    robot = read(TEXT)
    rows = (dataclasses.replace(robot.rows[0], upper=np.inf), *robot.rows[1:])
    with refused(RobotError, value="theta_1", expected="two limits or none"):
        robot_to_yaml(dataclasses.replace(robot, rows=rows))


FIXED = (Row("b", "fixed"), Row("c", "fixed"))
FINITE, RISING = "finite values up to 1e+06 m or rad", "a lower limit below the upper limit"
MANY = tuple(Row(str(i), "revolute") for i in range(1001))


@pytest.mark.parametrize(
    ("change", "expected", "value"),
    [
        ({"dh": np.zeros((2, 5))}, "shape (3, 5)", (2, 5)),
        ({"tool": np.array([np.nan, 0, 0, 0, 0, 0])}, FINITE, None),
        ({"dh": np.full((3, 5), 1e300)}, FINITE, None),
        ({"rows": MANY, "dh": np.zeros((1001, 5))}, "at most 1,000 rows", 1001),
        ({"rows": (Row("a", "prismatic", 1, 0.0, 1e12), *FIXED)}, "limits up to 1e+06 m", 1e12),
        ({"rows": (Row("a", "fixed"), *FIXED)}, "a joint", None),
        ({"rows": (Row("b", "revolute"), *FIXED)}, "", "b"),
        ({"rows": (Row("a", "revolute", 0), *FIXED)}, "+1 or -1", 0),
        ({"rows": (Row("a", "revolute", 1, 2.0, 1.0), *FIXED)}, RISING, (2.0, 1.0)),
        ({"rows": (Row("a", "revolute", 1, -np.inf, -np.inf), *FIXED)}, RISING, (-np.inf, -np.inf)),
    ],
)
def test_inconsistent_parts_are_rejected(change, expected, value):
    robot = read(TEXT)
    with refused(RobotError, expected=expected, value=value):
        dataclasses.replace(robot, **change)


def test_a_limit_that_is_not_a_number_is_rejected():
    with refused(RobotError, expected=RISING):
        dataclasses.replace(read(TEXT), rows=(Row("a", "revolute", 1, np.nan), *FIXED))


def test_the_arrays_of_a_robot_are_read_only():
    robot = read(TEXT)
    with pytest.raises(ValueError, match="read-only"):
        robot.dh[0, 0] = 1.0
    moved = robot.with_geometry(base=np.ones(6))
    assert_close(moved.base, np.ones(6), atol=0)
    assert_close(moved.dh, robot.dh, atol=0)
    with refused(PoseError, expected="2 columns", value=3):
        robot.check_joint_count(3)
