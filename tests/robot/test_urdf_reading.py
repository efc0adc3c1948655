"""URDF files: which chain is taken, and what is refused with what sentence."""

import math
import re
import subprocess
import sys

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.coupled import PALLETISER, coupled_robot

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
    """Write a text as a URDF file; gives its path."""

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


def test_the_axis_is_x_where_none_is_given(arm):
    assert_close(read_chain(arm(), "forearm", "tool0").joints[0].axis, [1, 0, 0], atol=0)


def test_an_axis_written_with_few_digits_is_a_unit_vector(arm):
    path = arm(changed('<axis xyz="0 0 -1"/>', '<axis xyz="0.577 0.577 0.577"/>'))
    assert_close(read_chain(path, tip="tool0").joints[0].axis, [3**-0.5] * 3, atol=1e-15)


def test_effort_and_velocity_may_be_missing(arm):
    path = arm(changed(' effort="10" velocity="3"/>\n    <dynamics', "/>\n    <dynamics"))
    assert Robot.load(path, tip="tool0").joints[0].upper == 1.5


@pytest.mark.parametrize(
    ("links", "complaint"),
    [
        ({}, "below 'world' the chain has 2 ends (camera, finger); say with tip which link is meant"),
        ({"tip": "tool"}, "there is no tip link 'tool'; did you mean 'tool0'? Valid: base, camera"),
        ({"base": "bas", "tip": "tool0"}, "there is no base link 'bas'; did you mean 'base'?"),
        ({"base": "camera", "tip": "tool0"}, "the link 'tool0' does not hang on 'camera'"),
        ({"base": "tool0", "tip": "base"}, "the link 'base' does not hang on 'tool0'"),
        ({"base": "flange", "tip": "tool0"}, "no joint moves between the links 'flange' and 'tool0'"),
        ({"base": "tool0", "tip": "tool0"}, "no joint moves between the links 'tool0' and 'tool0'"),
        (
            {"base": "tool0", "tip": "finger"},
            "line 34: joint 'grip' mimics 'slide', which is no commanded joint",
        ),
    ],
)
def test_links_that_make_no_chain(arm, links, complaint):
    with pytest.raises(RobotError, match=re.escape(complaint)) as caught:
        Robot.load(arm(), **links)
    assert str(caught.value).startswith(str(arm()))
    assert "\n" not in str(caught.value)


ELBOW = 'name="elbow" type="continuous"'
FOREARM = '<link name="forearm"/>'
AXIS = '<axis xyz="0 0 -1"/>'


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        (ELBOW, 'name="elbow" type="floating"', """name="elbow"|joint 'elbow' is floating"""),
        (ELBOW, 'name="elbow" type="planar"', """name="elbow"|joint 'elbow' is planar"""),
        (ELBOW, 'name="elbow" type="revolut"', "the type cannot be 'revolut'; did you mean 'revolute'"),
        (ELBOW, 'name="elbow"', """name="elbow"|joint 'elbow': the type cannot be 'None'"""),
        (ELBOW, 'name="elbow" type="revolute"', "has no <limit>; add lower and upper, or make it continuous"),
        (ELBOW, 'name="shoulder" type="continuous"', "the joint 'shoulder' stands twice, first in line 19"),
        (ELBOW, 'type="continuous"', "<joint type=|a joint has no name"),
        (FOREARM, '<link name="upper_arm"/>', "line 11: the link 'upper_arm' stands twice, first in line 10"),
        (FOREARM, "<link/>", "<link/>|a link has no name"),
        (FOREARM, "", """name="elbow"|the child 'forearm' of joint 'elbow' is no link; Valid: base"""),
        ('lower="-2"', 'lower="2"', "the lower limit 2 is not below the upper limit 1.5"),
        ('lower="-2" upper="1.5"', "", "the lower limit 0 is not below the upper limit 0 (0 where not given)"),
        ('lower="-2"', 'lower="nan"', 'lower="nan" of <limit> is not a finite number'),
        ('lower="-2"', 'lower="-2 3"', 'lower="-2 3" of <limit> is not a finite number'),
        (AXIS, '<axis xyz="0 0 0"/>', """name="shoulder"|joint 'shoulder' has an axis of length 0; a unit"""),
        (AXIS, '<axis xyz="0 0 2"/>', "has an axis of length 2"),
        (AXIS, '<axis xyz="0 1"/>', """<axis|joint 'shoulder': xyz="0 1" of <axis> is not three finite"""),
        (AXIS, "<axis/>", '<axis> lacks xyz="..."'),
        (AXIS, '<axis xyz="0 0 1"/><axis xyz="0 0 1"/>', "has <axis> twice"),
        ('xyz="0.4 0 0"', 'xyz="0.4, 0, 0"', 'xyz="0.4, 0, 0" of <origin> is not three finite numbers with spaces'),
        ('xyz="0.4 0 0"', 'xyz="0.4 0 1e999"', "is not three finite numbers"),
        ('xyz="0.4 0 0"', 'xyz="0.4 0 1e200"', "is not three finite numbers with spaces between, 1e+06 at most"),
        ('rpy="1.5707963267948966 0 0"', 'rpy="${pi/2} 0 0"', 'rpy="${pi/2} 0 0" of <origin> is not'),
        ('<parent link="upper_arm"/>', "", """name="elbow"|joint 'elbow': <parent link="..."/> is missing"""),
        ('<child link="camera"/>', "<child/>", """joint 'eye': <child link="..."/> is missing"""),
        ('<child link="camera"/>', '<child link="tool0"/>', "'tool0' is the child of two joints, 'tool' and 'eye'"),
        ('<parent link="world"/>', '<parent link="tool0"/>', "the joints form a loop"),
        ("</robot>", "", "is truncated or no XML"),
        ('<link name="tool0"/>', '<xacro:macro name="a"/>', "is xacro, which is not read"),
    ],
)  # fmt: skip
def test_mistakes_are_refused_with_file_and_line(arm, old, new, complaint):
    """A complaint may begin with a piece of the line that it has to name, and a bar."""
    text = changed(old, new)
    if "loop" in complaint:
        text = text.replace('<link name="world"/>', "").replace('"world"', '"tool0"')
    with pytest.raises(RobotError) as caught:
        Robot.load(arm(text), tip="tool0")
    sentence = str(caught.value)
    assert sentence.startswith(str(arm(text)))
    assert "\n" not in sentence
    if "|" in complaint:
        piece, complaint = complaint.split("|")
        line = next(i for i, row in enumerate(text.splitlines(), 1) if piece in row)
        complaint = f", line {line}: {complaint}"
    assert complaint in sentence


@pytest.mark.parametrize(
    "content", [b"", b"solid teapot", b"\xff\xfe\x00", b"name: arm\nrows: []\n", b"<robot"]
)
def test_no_xml(tmp_path, content):
    path = tmp_path / "arm.urdf"
    path.write_bytes(content)
    with pytest.raises(RobotError, match="is truncated or no XML") as caught:
        Robot.load(path)
    assert "\n" not in str(caught.value)


def test_other_xml(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text("<mujoco/>")
    with pytest.raises(RobotError, match="the root is <mujoco>"):
        Robot.load(path)
    path.write_text("<robot name='a'/>")
    with pytest.raises(RobotError, match="holds no link"):
        Robot.load(path)
    path.write_text("<robot name='a'><link name='a'/><link name='b'/></robot>")
    with pytest.raises(RobotError, match="2 links have no parent"):
        Robot.load(path)
    path.write_text("<robot name='a'><link name='a'/></robot>")
    with pytest.raises(RobotError, match="no joint moves between the links 'a' and 'a'"):
        Robot.load(path)


def test_entities_are_neither_read_from_files_nor_blown_up(tmp_path):
    (tmp_path / "secret").write_text("secret")
    path = tmp_path / "arm.urdf"
    outer = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{tmp_path / "secret"}">]>'
    path.write_text(f"{outer}<robot name='a'>&x;<link name='a'/></robot>")
    with pytest.raises(RobotError, match="no joint moves") as caught:
        Robot.load(path)
    assert "secret" not in str(caught.value).replace(str(tmp_path), "")
    laughs = "".join(f'<!ENTITY l{i + 1} "{f"&l{i};" * 10}">' for i in range(12))
    path.write_text(f'<!DOCTYPE robot [<!ENTITY l0 "ha">{laughs}]><robot name="&l12;"/>')
    with pytest.raises(RobotError, match="no XML"):
        Robot.load(path)


def test_files_that_are_not_there_or_no_urdf(tmp_path):
    with pytest.raises(RobotError, match="cannot be read"):
        Robot.load(tmp_path / "none.urdf")
    (tmp_path / "folder.urdf").mkdir()
    with pytest.raises(RobotError, match="cannot be read"):
        Robot.load(tmp_path / "folder.urdf")
    (tmp_path / "arm.urdf.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="a"/></robot>'
    )
    with pytest.raises(RobotError, match=r"is xacro, which is not read; expand it first"):
        Robot.load(tmp_path / "arm.urdf.xacro")
    with pytest.raises(UnknownRobotError, match=r"no \.yaml or \.urdf file"):
        Robot.load("arm.sdf")


@pytest.mark.parametrize("option", ["base", "tip"])
@pytest.mark.parametrize("robot", ["ur10", "arm.yaml"])
def test_links_belong_to_urdf_files(robot, option):
    with pytest.raises(
        RobotError, match=f"{option}='tool0' names a link of a URDF file, but '{robot}' is none"
    ):
        Robot.load(robot, **{option: "tool0"})


def test_other_robots_do_without_the_parser():
    script = (
        "import sys, pisigma\npisigma.Robot.load('ur10')\n"
        "print([name for name in ('pytorch_kinematics', 'lxml', 'matplotlib', 'torch') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "[]\n"), done.stderr


def test_every_truncated_file_is_refused_and_every_damaged_one_refused_or_read(tmp_path):
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


def test_a_file_of_more_links_than_any_cell_has_is_refused_at_once(tmp_path):
    path = tmp_path / "many.urdf"
    path.write_text(
        f'<robot name="r">{"".join(f"<link name={i!r}/>" for i in map(str, range(10_001)))}</robot>'
    )
    with pytest.raises(RobotError, match="holds more than 10,000 links and joints; fewer were wanted"):
        Robot.load(path)


def test_a_joint_that_mimics_another_is_coupled_to_it(arm):
    text = TEXT.replace('multiplier="2"', 'multiplier="2" offset="0.01"')
    robot = Robot.load(arm(text), tip="finger")
    assert [axis.name for axis in robot.axes] == ["shoulder", "elbow", "slide"]
    q = np.array([[0.3, -0.4, 0.2]])
    assert_close(robot.to_dh(q), [[0.3, -0.4, 0.2, 0.41]], atol=1e-15)
    assert_close(robot.to_controller(robot.to_dh(q)), q, atol=1e-15)


def test_coupled_joints_are_written_as_joints_that_mimic(arm):
    robot = coupled_robot()
    again = Robot.load(arm(robot_to_urdf(robot)))
    assert [axis.name for axis in again.axes] == [axis.name for axis in robot.axes]
    assert_close(again.axis_limits, robot.axis_limits, atol=1e-15)
    q = np.random.default_rng(0).uniform(-1, 1, (5, 6))
    assert_close(pisigma.forward_kinematics(again, q), pisigma.forward_kinematics(robot, q), atol=1e-12)
    with pytest.raises(OutputError, match="four-bar linkage drives the joint 'theta_3'"):
        robot_to_urdf(coupled_robot(PALLETISER))
