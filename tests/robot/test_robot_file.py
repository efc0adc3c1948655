"""Robot files: what is read, what is refused and with what sentence."""

import dataclasses

import numpy as np
import pytest
from testing.closeness import assert_close

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
    return Robot(*parse_yaml(text, RobotDocument, RobotError, "arm.yaml").drawing())


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
def test_every_robot_of_the_catalogue_loads_and_survives_its_file(name):
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
    ("old", "new", "complaint"),
    [
        ("direction: -1", "direction: 2", r"line 6: 'rows.1.direction': .*1 or -1"),
        ("direction: -1", "direction: -1.5", r"line 6: 'rows.1.direction'"),
        ("[-90, 180]", "[180, -90]", r"line 5: .*lower limit 180 of row 'theta_1' .*; swap"),
        ("[-90, 180]", "[180, 180]", "line 5: .*lower limit 180"),
        ("[-90, 180]", "[-90]", "line 5: "),
        ("[-90, 180]", "[-90, .nan]", "line 5: .*finite"),
        ("limits_deg: [-90, 180]", "limits_mm: [0, 1]", "line 5: .*revolute and cannot have limits_mm"),
        ("limits_mm: [0, 300]", "limits_deg: [0, 3]", "line 6: .*prismatic and cannot have limits_deg"),
        ("type: fixed", "type: fixed, limits_mm: [0, 3]", "line 7: .*fixed and cannot have limits_mm"),
        ("d_mm: 100", "d_m: 0.1", r"line 5: unknown key 'd_m' in 'rows.0'; did you mean 'd_mm'"),
        ("alpha_deg", "alpha_rad", "line 5: unknown key 'alpha_rad'.*did you mean 'alpha_deg'"),
        ("type: revolute", "type: revolut", "line 5: 'rows.0.type' cannot be 'revolut'; did you mean 'revolute'"),
        ("name: d_2", "name: theta_1", "the row name 'theta_1' stands twice"),
        ("d_mm: 100", "d_mm: '100'", "line 5: 'rows.0.d_mm': .*number, but got '100'"),
        ("d_mm: 100", "d_mm: 1e300", "line 5: 'rows.0.d_mm': .*less than or equal to 1000000000"),
        ("limits_mm: [0, 300]", "limits_mm: [0, 1e12]", "line 6: 'rows.1.limits_mm.1'"),
        ("d_mm: 100", "d_mm: yes", "line 5: 'rows.0.d_mm': .*number, but got 'yes'"),
        ("maker: nobody\n", "", "the key 'maker' is missing in 'the file'"),
        ("name: theta_1, ", "", "line 5: the key 'name' is missing in 'rows.0'"),
        ("x_mm: 1", "x_mm: .inf", "line 8: 'base.x_mm': .*finite"),
        ("base:", "bas:", "line 8: unknown key 'bas' in 'the file'; did you mean 'base'"),
    ],
)  # fmt: skip
def test_mistakes_are_refused_with_file_line_and_key(old, new, complaint):
    assert old in TEXT
    with pytest.raises(RobotError, match=complaint) as caught:
        read(TEXT.replace(old, new, 1))
    assert str(caught.value).startswith("arm.yaml")
    assert "\n" not in str(caught.value)


def test_rows_are_wanted_and_one_must_move():
    start = TEXT[: TEXT.index("rows:")]
    with pytest.raises(RobotError, match="'rows' is missing"):
        read(start)
    with pytest.raises(RobotError, match="line 4: 'rows'"):
        read(start + "rows: []\n")
    with pytest.raises(RobotError, match="no row moves"):
        read(start + "rows: [{name: a, type: fixed}]\n")


def test_unknown_robots_are_refused_with_the_nearest(tmp_path):
    with pytest.raises(UnknownRobotError, match="did you mean 'ur10'"):
        Robot.load("ur100")
    with pytest.raises(RobotError, match="cannot be read"):
        Robot.load(tmp_path / "none.yaml")
    (tmp_path / "arm.yml").write_text(TEXT)
    assert Robot.load(tmp_path / "arm.yml").name == "arm"


def test_one_limit_cannot_be_written():
    robot = read(TEXT)
    rows = (dataclasses.replace(robot.rows[0], upper=np.inf), *robot.rows[1:])
    with pytest.raises(RobotError, match="one limit only"):
        robot_to_yaml(dataclasses.replace(robot, rows=rows))


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"dh": np.zeros((2, 5))}, r"dh of shape \(3, 5\)"),
        ({"tool": np.array([np.nan, 0, 0, 0, 0, 0])}, "tool has an entry that is not finite"),
        ({"dh": np.full((3, 5), 1e300)}, "dh has an entry that is not finite or over"),
        ({"rows": tuple(Row(str(i), "revolute") for i in range(1001)), "dh": np.zeros((1001, 5))}, "1,001 rows; 1,000"),
        ({"rows": (Row("a", "prismatic", 1, 0.0, 1e12), Row("b", "fixed"), Row("c", "fixed"))}, "a limit is above"),
        ({"rows": (Row("a", "fixed"), Row("b", "fixed"), Row("c", "fixed"))}, "no joint that moves"),
        ({"rows": (Row("a", "revolute"), Row("a", "fixed"), Row("c", "fixed"))}, "'a' stands twice"),
        ({"rows": (Row("a", "revolute", 0), Row("b", "fixed"), Row("c", "fixed"))}, "direction is"),
        ({"rows": (Row("a", "revolute", 1, 2.0, 1.0), Row("b", "fixed"), Row("c", "fixed"))}, "lower limit 2"),
        ({"rows": (Row("a", "revolute", 1, np.nan), Row("b", "fixed"), Row("c", "fixed"))}, "lower limit nan"),
    ],
)  # fmt: skip
def test_parts_that_do_not_fit_are_refused(change, complaint):
    robot = read(TEXT)
    with pytest.raises(RobotError, match=complaint):
        dataclasses.replace(robot, **change)


def test_a_robot_cannot_be_changed_behind_its_back():
    robot = read(TEXT)
    with pytest.raises(ValueError, match="read-only"):
        robot.dh[0, 0] = 1.0
    moved = robot.with_geometry(base=np.ones(6))
    assert_close(moved.base, np.ones(6), atol=0)
    assert_close(moved.dh, robot.dh, atol=0)
    with pytest.raises(PoseError, match="has 2 joints"):
        robot.check_joint_count(3)
