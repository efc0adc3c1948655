"""Chains are read from URDF files, and mistakes are rejected with file and line."""

import math
import subprocess
import sys

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.coupled import PALLETISER, coupled_robot
from testing.refusals import refused

import pisigma
from pisigma.files.errors import OutputError, RobotError, UnknownRobotError
from pisigma.robot import Robot
from pisigma.robot.urdf_chain import read_chain
from pisigma.robot.writing import robot_to_urdf

TEXT = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- an arm with a camera and a gripper -->
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <material name="grey"><color rgba="0.5 0.5 0.5 1"/></material>
  <link name="world"/>
  <link name="base">
    <visual><geometry><mesh filename="package://nowhere/base.stl"/></geometry></visual>
    <inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
  </link>
  <link name="upper_arm"/>
  <link name="forearm"/>
  <link name="camera"/>
  <link name="flange"/>
  <link name="tool0"/>
  <link name="finger"/>
  <joint name="stand" type="fixed">
    <origin xyz="0 0 0.5"/><parent link="world"/><child link="base"/>
  </joint>
  <joint name="shoulder" type="revolute">
    <origin xyz="0 0 0.2" rpy="0 0 0"/><parent link="base"/><child link="upper_arm"/>
    <axis xyz="0 0 -1"/><limit lower="-2" upper="1.5" effort="10" velocity="3"/>
    <dynamics damping="0.1"/><safety_controller k_velocity="1"/>
  </joint>
  <joint name="elbow" type="continuous">
    <origin xyz="0.4 0 0" rpy="1.5707963267948966 0 0"/><parent link="upper_arm"/><child link="forearm"/>
    <axis xyz="0 0 1"/>
  </joint>
  <joint name="slide" type="prismatic">
    <parent link="forearm"/><child link="flange"/>
    <limit lower="0" upper="0.3" effort="10" velocity="3"/>
  </joint>
  <joint name="tool" type="fixed"><parent link="flange"/><child link="tool0"/></joint>
  <joint name="eye" type="fixed"><parent link="forearm"/><child link="camera"/></joint>
  <joint name="grip" type="prismatic">
    <parent link="tool0"/><child link="finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.1" effort="10" velocity="3"/><mimic joint="slide" multiplier="2"/>
  </joint>
  <gazebo reference="base"><anything/></gazebo>
  <ros2_control name="x" type="system"/>
</robot>
"""


@pytest.fixture
def arm(tmp_path):
    """Return a function that writes a text as a URDF file and returns its path."""

    def write(text: str = TEXT):
        path = tmp_path / "arm.urdf"
        path.write_text(text)
        return path

    return write


def changed(old: str, new: str) -> str:
    assert TEXT.count(old) == 1, old
    return TEXT.replace(old, new)


def test_the_chain_of_a_tree(arm, capfd):
    robot = Robot.load(arm(), tip="tool0")
    assert robot.name == "arm"
    assert "arm.urdf" in robot.source
    assert "'world'" in robot.source
    assert [(j.name, j.type, j.direction) for j in robot.joints] == [
        ("shoulder", "revolute", -1),
        ("elbow", "revolute", 1),
        ("slide", "prismatic", 1),
    ]
    assert_close(robot.limits, [[-2, 1.5], [-math.inf, math.inf], [0, 0.3]], atol=0)
    assert capfd.readouterr() == ("", "")
    shorter = Robot.load(arm(), base="upper_arm", tip="camera")
    assert [joint.name for joint in shorter.joints] == ["elbow"]


def test_the_default_axis_is_x(arm):
    assert_close(read_chain(arm(), "forearm", "tool0").joints[0].axis, [1, 0, 0], atol=0)


def test_an_axis_written_with_few_digits_is_a_unit_vector(arm):
    path = arm(changed('<axis xyz="0 0 -1"/>', '<axis xyz="0.577 0.577 0.577"/>'))
    assert_close(read_chain(path, tip="tool0").joints[0].axis, [3**-0.5] * 3, atol=1e-15)


def test_effort_and_velocity_may_be_missing(arm):
    path = arm(changed(' effort="10" velocity="3"/>\n    <dynamics', "/>\n    <dynamics"))
    assert Robot.load(path, tip="tool0").joints[0].upper == 1.5


@pytest.mark.parametrize(
    ("links", "fields"),
    [
        ({}, {"expected": "one end", "value": 2}),
        ({"tip": "tool"}, {"option": "tip", "value": "tool"}),
        ({"base": "bas", "tip": "tool0"}, {"option": "base", "value": "bas"}),
        ({"base": "camera", "tip": "tool0"}, {"option": "", "value": "tool0", "line": None}),
        ({"base": "tool0", "tip": "base"}, {"option": "", "value": "base", "line": None}),
        ({"base": "flange", "tip": "tool0"}, {"expected": "a joint that moves"}),
        ({"base": "tool0", "tip": "tool0"}, {"expected": "a joint that moves"}),
        ({"base": "tool0", "tip": "finger"}, {"line": 34, "value": "slide"}),
    ],
)
def test_links_without_a_chain_are_rejected(arm, links, fields):
    with refused(RobotError, file=arm(), **fields) as caught:
        Robot.load(arm(), **links)
    assert "\n" not in str(caught.value)
    if near := {"tool": "'tool0'?", "bas": "'base'?"}.get(str(fields.get("value"))):
        assert near in caught.value.remedy


ELBOW = 'name="elbow" type="continuous"'
FOREARM = '<link name="forearm"/>'
AXIS = '<axis xyz="0 0 -1"/>'
VECTOR = "three finite numbers separated by spaces up to 1e+06"
NUMBER = "a finite number up to 1e+18"


@pytest.mark.parametrize(
    ("old", "new", "fields"),
    [
        (ELBOW, 'name="elbow" type="floating"', {"line": 'name="elbow"', "value": "floating"}),
        (ELBOW, 'name="elbow" type="planar"', {"line": 'name="elbow"', "value": "planar"}),
        (ELBOW, 'name="elbow" type="revolut"', {"line": 'name="elbow"', "value": "revolut"}),
        (ELBOW, 'name="elbow"', {"line": 'name="elbow"', "value": None}),
        (ELBOW, 'name="elbow" type="revolute"', {"line": 'name="elbow"', "expected": "<limit>"}),
        (ELBOW, 'name="shoulder" type="continuous"', {"line": "continuous", "value": "shoulder"}),
        (ELBOW, 'type="continuous"', {"line": "<joint type=", "expected": "a name"}),
        (FOREARM, '<link name="upper_arm"/>', {"line": 11, "value": "upper_arm"}),
        (FOREARM, "<link/>", {"line": "<link/>", "expected": "a name"}),
        (FOREARM, "", {"line": 'name="elbow"', "value": "forearm"}),
        ('lower="-2"', 'lower="2"', {"value": (2.0, 1.5)}),
        ('lower="-2" upper="1.5"', "", {"value": (0.0, 0.0)}),
        ('lower="-2"', 'lower="nan"', {"expected": NUMBER, "value": "nan"}),
        ('lower="-2"', 'lower="-2 3"', {"expected": NUMBER, "value": "-2 3"}),
        (AXIS, '<axis xyz="0 0 0"/>', {"line": 'name="shoulder"', "value": 0.0}),
        (AXIS, '<axis xyz="0 0 2"/>', {"line": 'name="shoulder"', "value": 2.0}),
        (AXIS, '<axis xyz="0 1"/>', {"line": "<axis", "expected": VECTOR, "value": "0 1"}),
        (AXIS, "<axis/>", {"expected": "<axis xyz>"}),
        (AXIS, '<axis xyz="0 0 1"/><axis xyz="0 0 1"/>', {"value": "axis"}),
        ('xyz="0.4 0 0"', 'xyz="0.4, 0, 0"', {"expected": VECTOR, "value": "0.4, 0, 0"}),
        ('xyz="0.4 0 0"', 'xyz="0.4 0 1e999"', {"expected": VECTOR, "value": "0.4 0 1e999"}),
        ('xyz="0.4 0 0"', 'xyz="0.4 0 1e200"', {"expected": VECTOR, "value": "0.4 0 1e200"}),
        ('rpy="1.5707963267948966 0 0"', 'rpy="${pi/2} 0 0"', {"expected": VECTOR, "value": "${pi/2} 0 0"}),
        ('<parent link="upper_arm"/>', "", {"line": 'name="elbow"', "expected": "<parent>"}),
        ('<child link="camera"/>', "<child/>", {"line": 'name="eye"', "expected": "<child>"}),
        ('<child link="camera"/>', '<child link="tool0"/>', {"value": "tool0"}),
        ('<parent link="world"/>', '<parent link="tool0"/>', {"expected": "a tree with one root link", "value": 0}),
        ("</robot>", "", {"expected": "a complete URDF file"}),
        ('<link name="tool0"/>', '<xacro:macro name="a"/>', {"value": "xacro"}),
    ],
)  # fmt: skip
def test_mistakes_are_rejected_with_file_and_line(arm, old, new, fields):
    """A text instead of a line number is a part of the line to be named."""
    text = changed(old, new)
    if fields.get("value") == 0 and "expected" in fields:  # a loop
        text = text.replace('<link name="world"/>', "").replace('"world"', '"tool0"')
    if isinstance(piece := fields.get("line"), str):
        fields = fields | {"line": next(i for i, row in enumerate(text.splitlines(), 1) if piece in row)}
    with refused(RobotError, file=arm(text), **fields) as caught:
        Robot.load(arm(text), tip="tool0")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content", [b"", b"solid teapot", b"\xff\xfe\x00", b"name: arm\nrows: []\n", b"<robot"]
)
def test_files_that_are_not_xml_are_rejected(tmp_path, content):
    path = tmp_path / "arm.urdf"
    path.write_bytes(content)
    with refused(RobotError, file=path, expected="a complete URDF file") as caught:
        Robot.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected", "value"),
    [
        ("<mujoco/>", "a URDF file", "mujoco"),
        ("<robot name='a'/>", "a URDF with links and joints", None),
        ("<robot name='a'><link name='a'/><link name='b'/></robot>", "a tree with one root link", 2),
        ("<robot name='a'><link name='a'/></robot>", "a joint that moves", None),
    ],
)
def test_other_xml_is_rejected(tmp_path, text, expected, value):
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with refused(RobotError, file=path, expected=expected, value=value):
        Robot.load(path)


def test_entities_are_neither_read_from_files_nor_expanded(tmp_path):
    (tmp_path / "secret").write_text("secret")
    path = tmp_path / "arm.urdf"
    outer = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{tmp_path / "secret"}">]>'
    path.write_text(f"{outer}<robot name='a'>&x;<link name='a'/></robot>")
    with refused(RobotError, expected="a joint that moves") as caught:
        Robot.load(path)
    assert "secret" not in str(caught.value).replace(str(tmp_path), "")
    laughs = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(12))
    path.write_text(f'<!DOCTYPE robot [<!ENTITY l0 "ha">{laughs}]><robot name="&l12;"/>')
    with refused(RobotError, expected="a complete URDF file"):
        Robot.load(path)


def test_missing_files_folders_xacro_and_other_formats_are_rejected(tmp_path):
    with refused(RobotError, file="none.urdf", value="No such file or directory"):
        Robot.load(tmp_path / "none.urdf")
    (tmp_path / "folder.urdf").mkdir()
    with refused(RobotError, file="folder.urdf", value="Is a directory"):
        Robot.load(tmp_path / "folder.urdf")
    (tmp_path / "arm.urdf.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>'
    )
    with refused(RobotError, file="arm.urdf.xacro", expected="a URDF file", value="xacro"):
        Robot.load(tmp_path / "arm.urdf.xacro")
    with refused(UnknownRobotError, value="arm.sdf"):
        Robot.load("arm.sdf")


@pytest.mark.parametrize("option", ["base", "tip"])
@pytest.mark.parametrize("robot", ["ur10", "arm.yaml"])
def test_links_are_accepted_for_urdf_files_only(robot, option):
    with refused(RobotError, option=option, value="tool0"):
        Robot.load(robot, **{option: "tool0"})


def test_other_robots_do_not_import_the_parser():
    script = (
        "import sys, pisigma\npisigma.Robot.load('ur10')\n"
        "print([name for name in ('pytorch_kinematics', 'lxml', 'matplotlib', 'torch') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


def test_truncated_files_are_rejected_and_damaged_ones_rejected_or_read(tmp_path):
    path = tmp_path / "arm.urdf"
    end = TEXT.rindex("</robot>") + len("</robot>")
    for length in range(0, end, 11):
        path.write_text(TEXT[:length])
        with pytest.raises(RobotError):
            Robot.load(path, tip="tool0")
    random = np.random.default_rng(0)
    read = 0
    for _ in range(300):
        damaged = bytearray(TEXT.encode())
        damaged[random.integers(end)] = random.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            read += Robot.load(path, tip="tool0").dof
        except RobotError as problem:
            assert "\n" not in str(problem)  # noqa: PT017
    assert read


def test_a_file_with_too_many_links_is_rejected_at_once(tmp_path):
    path = tmp_path / "many.urdf"
    path.write_text(
        f'<robot name="r">{"".join(f"<link name={i!r}/>" for i in map(str, range(10_001)))}</robot>'
    )
    with refused(RobotError, file=path, expected="at most 10,000 links and joints"):
        Robot.load(path)


def test_a_joint_that_mimics_another_is_coupled_to_it(arm):
    text = TEXT.replace('multiplier="2"', 'multiplier="2" offset="0.01"')
    robot = Robot.load(arm(text), tip="finger")
    assert [axis.name for axis in robot.axes] == ["shoulder", "elbow", "slide"]
    q = np.array([[0.3, -0.4, 0.2]])
    assert_close(robot.to_dh(q), [[0.3, -0.4, 0.2, 0.41]], atol=1e-15)
    assert_close(robot.to_controller(robot.to_dh(q)), q, atol=1e-15)


def test_coupled_joints_are_written_as_mimic_joints(arm):
    robot = coupled_robot()
    again = Robot.load(arm(robot_to_urdf(robot)))
    assert [axis.name for axis in again.axes] == [axis.name for axis in robot.axes]
    assert_close(again.axis_limits, robot.axis_limits, atol=1e-15)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    assert_close(pisigma.forward_kinematics(again, q), pisigma.forward_kinematics(robot, q), atol=1e-12)
    with refused(OutputError, value="theta_3"):
        robot_to_urdf(coupled_robot(PALLETISER))
