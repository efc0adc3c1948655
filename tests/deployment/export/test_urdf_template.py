"""A calibrated robot in its URDF file: exact forward kinematics, other content unchanged."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lxml import etree
from testing.closeness import assert_close
from testing.refusals import refused
from testing.urdf import UrdfJoint, peer_poses, urdf_text

from pisigma.deployment.export.urdf import update_urdf
from pisigma.files.errors import RobotError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

TEXT = """\
<robot name="arm">
  <!-- meshes stay -->
  <link name="world"/>
  <link name="base"><visual><geometry><mesh filename="package://arm/base.stl"/></geometry></visual></link>
  <link name="a"/><link name="bracket"/><link name="b"/><link name="c"/><link name="tool0"/><link name="camera"/>
  <joint name="stand" type="fixed"><origin xyz="0 0 0.5"/><parent link="world"/><child link="base"/></joint>
  <joint name="one" type="revolute">
    <origin xyz="0 0 0.2" rpy="0 0 0.3"/><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="1.5" effort="10" velocity="3"/>
  </joint>
  <joint name="screwed" type="fixed">
    <origin xyz="0.1 0 0.1" rpy="1.5707963267948966 0 0"/><parent link="a"/><child link="bracket"/>
  </joint>
  <joint name="two" type="continuous">
    <origin xyz="0.2 0 0.1"/><parent link="bracket"/><child link="b"/><axis xyz="0 -0.6 0.8"/>
  </joint>
  <joint name="three" type="prismatic">
    <parent link="b"/><child link="c"/><axis xyz="0 -1 0"/><limit lower="0" upper="0.3" effort="7" velocity="2"/>
  </joint>
  <joint name="flange" type="fixed"><origin xyz="0 0.1 0"/><parent link="c"/><child link="tool0"/></joint>
  <joint name="eye" type="fixed"><origin xyz="0 0.2 0"/><parent link="a"/><child link="camera"/></joint>
  <gazebo reference="base"><mu1>0.2</mu1></gazebo>
  <ros2_control name="arm" type="system"><joint name="one"><command_interface name="position"/></joint></ros2_control>
</robot>
"""


def calibrated_like(nominal: Robot, seed: int, size: float = 1e-3) -> Robot:
    random = np.random.default_rng(seed)
    dh = nominal.dh + random.normal(0, size, nominal.dh.shape)
    return nominal.with_geometry(dh, random.normal(0, 1, 6), random.normal(0, 0.1, 6))


def joint_values(robot: Robot) -> torch.Tensor:
    generator = torch.Generator().manual_seed(2)
    return 4 * torch.rand((20, robot.dof), generator=generator, dtype=torch.float64) - 2


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "arm.urdf"
    found.write_text(TEXT)
    return found


def test_only_origins_change(path, tmp_path):
    nominal = Robot.load(path, tip="tool0")
    robot = calibrated_like(nominal, 1)
    out = tmp_path / "out.urdf"
    out.write_text(update_urdf(robot, nominal, path, "tool0", ("said -- once",)))
    q = joint_values(robot)
    again = Robot.load(out, base="calibrated_frame", tip="calibrated_tool")
    assert_close(forward_kinematics(again, q), forward_kinematics(robot, q), atol=1e-12)
    assert_close(peer_poses(out, "calibrated_tool", q), forward_kinematics(robot, q), atol=1e-10)
    assert [joint.name for joint in again.joints] == ["one", "two", "three"]
    before, after = etree.fromstring(TEXT), etree.fromstring(out.read_text())
    for tag in ("visual", "limit", "axis", "parent", "child", "gazebo", "ros2_control"):
        old = [etree.tostring(e, with_tail=False) for e in before.iter(tag)]
        new = [etree.tostring(e, with_tail=False) for e in after.iter(tag)]
        assert [b"".join(text.split()) for text in new[: len(old)]] == [
            b"".join(text.split()) for text in old
        ]
    # An SRDF names links and joints, which are all still there.
    for tag in ("link", "joint"):
        assert {e.get("name") for e in before.iter(tag)} <= {e.get("name") for e in after.iter(tag)}
    moved = {
        joint.get("name")
        for joint in before.findall("joint")
        if etree.tostring(
            joint.find("origin") if joint.find("origin") is not None else joint, with_tail=False
        )
        != etree.tostring(after.find(f"joint[@name='{joint.get('name')}']/origin"), with_tail=False)
    }
    assert moved == {"two", "three"}
    assert "<!-- said - - once -->" in out.read_text()
    assert "<!-- meshes stay -->" in out.read_text()
    origin = after.find("joint[@name='two']/origin")
    assert_close([float(word) for word in origin.get("xyz").split()], [0.2, 0, 0.1], atol=0.01)


def test_the_nominal_robot_changes_nothing(path, tmp_path):
    nominal = Robot.load(path, tip="tool0")
    out = tmp_path / "out.urdf"
    out.write_text(update_urdf(nominal, nominal, path, "tool0"))
    again = Robot.load(out, tip="tool0", base="world")
    assert_close(again.dh, nominal.dh, atol=1e-14)
    for name, origin in (("calibrated_frame_joint", np.zeros(6)), ("calibrated_tool_joint", np.zeros(6))):
        part = etree.fromstring(out.read_text()).find(f"joint[@name='{name}']/origin")
        numbers = [float(word) for key in ("xyz", "rpy") for word in part.get(key).split()]
        assert_close(numbers, origin, atol=1e-14)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 8))
def test_any_chain(tmp_path_factory, seed, count):
    random = np.random.default_rng(seed)
    chain = [
        UrdfJoint(
            random.choice(["revolute", "continuous", "prismatic", "fixed"]) if i else "revolute",
            random.uniform(-1, 1, 3),
            random.choice([0.0, np.pi / 2, -np.pi / 2, 0.3], 3),
            random.permutation([1.0, 0.0, 0.0]) * random.choice([-1, 1]),
        )
        for i in range(count)
    ]
    path = tmp_path_factory.mktemp("chain") / "chain.urdf"
    path.write_text(urdf_text(chain))
    nominal = Robot.load(path)
    robot = calibrated_like(nominal, seed)
    path.write_text(update_urdf(robot, nominal, path))
    q = joint_values(robot)
    assert_close(peer_poses(path, "calibrated_tool", q), forward_kinematics(robot, q), atol=1e-10)
    assert_close(forward_kinematics(Robot.load(path), q), forward_kinematics(robot, q), atol=1e-12)


def test_files_of_other_robots_are_refused(path):
    nominal = Robot.load(path, tip="tool0")
    with refused(RobotError, option="--like", value="one, two, three"):
        update_urdf(Robot.load("ur10"), Robot.load("ur10"), path, "tool0")
    longer = nominal.with_geometry(nominal.dh + 0.01)
    with refused(RobotError, option="--like", expected="the geometry of the nominal robot"):
        update_urdf(longer, longer, path, "tool0")
    with pytest.raises(RobotError, match="2"):
        update_urdf(nominal, nominal, path)


def test_missing_values_that_simulators_require_are_filled_in(path, tmp_path):
    mass = '<inertial><mass value="3"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = TEXT.replace('<link name="bracket"/>', f'<link name="bracket">{mass}</link>')
    path.write_text(text.replace('effort="7"', 'effort="0"'))
    nominal = Robot.load(path, tip="tool0")
    after = etree.fromstring(update_urdf(nominal, nominal, path, "tool0").encode())
    masses = {link.get("name"): link.find("inertial/mass") for link in after.iter("link")}
    stated = {name: mass.get("value") for name, mass in masses.items() if mass is not None}
    assert stated == {"bracket": "3", "b": "1", "c": "1"}  # the bracket is fixed to link a
    limits = [(limit.get("effort"), limit.get("velocity")) for limit in after.iter("limit")]
    assert limits == [("10", "3"), ("1000", "2")]


def test_a_base_that_is_not_the_root(path, tmp_path):
    nominal = Robot.load(path, base="bracket", tip="tool0")
    robot, out = calibrated_like(nominal, 2), tmp_path / "out.urdf"
    out.write_text(update_urdf(robot, nominal, path, "tool0", base="bracket"))
    q = joint_values(robot)
    again = Robot.load(out, base="calibrated_frame", tip="calibrated_tool")
    assert_close(forward_kinematics(again, q), forward_kinematics(robot, q), atol=1e-12)
    whole = torch.cat([q[:, :1], q], 1)
    base, before = (Robot.load(one, base="world", tip="bracket") for one in (out, path))
    assert_close(forward_kinematics(base, whole[:, :1]), forward_kinematics(before, whole[:, :1]), atol=1e-12)
