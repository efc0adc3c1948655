"""A calibrated robot in an existing MJCF model: exact forward kinematics, other content unchanged."""

import copy

import numpy as np
import pytest
import torch
from lxml import etree
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.deployment.export.mjcf import update_mjcf, urdf_to_mjcf
from pisigma.files.errors import RobotError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.mjcf_file import MjcfDrawing
from pisigma.robot.urdf_frames import rotation, translation
from pisigma.robot.writing import robot_to_urdf

UR5E = """\
<mujoco model="drawn">
  <!-- as in MuJoCo Menagerie: rounded to millimetres, axes from classes -->
  <compiler meshdir="assets"/>
  <default>
    <joint damping="3"/>
    <default class="arm">
      <joint axis="0 1 0" range="-180 180" armature="0.1"/>
      <default class="upright"><joint axis="0 0 1"/></default>
    </default>
  </default>
  <asset><mesh name="forearm" file="forearm.obj"/></asset>
  <worldbody>
    <body name="base" quat="0 0 0 -1" childclass="arm">
      <body name="shoulder" pos="0 0 0.163">
        <inertial mass="3.7" pos="0 0 0" diaginertia="0.0102675 0.0102675 0.00666"/>
        <joint name="shoulder_pan_joint" class="upright"/>
        <body name="upper_arm" pos="0 0.138 0" euler="0 90 0">
          <joint name="shoulder_lift_joint"/>
          <body name="bracket" pos="0 -0.131 0"><body name="forearm" pos="0 0 0.425">
            <joint name="elbow_joint"/><geom type="mesh" mesh="forearm"/>
            <body name="wrist_1" pos="0 0 0.392" axisangle="0 1 0 90">
              <joint name="wrist_1_joint"/>
              <body name="wrist_2" pos="0 0.127 0">
                <joint name="wrist_2_joint" class="upright"/>
                <body name="wrist_3" pos="0 0 0.1" xyaxes="1 0 0 0 1 0">
                  <joint name="wrist_3_joint"/>
                </body>
              </body>
            </body>
          </body></body>
        </body>
      </body>
      <body name="button"><joint name="button"/></body>
    </body>
  </worldbody>
  <actuator><position name="lift" joint="shoulder_lift_joint" kp="2000"/></actuator>
</mujoco>
"""


def pose_in(path, robot: Robot, q: np.ndarray) -> np.ndarray:
    """Compute the pose of the tool's site in that of the frame, from the poses of the bodies."""
    drawing = MjcfDrawing.read(path)
    moved = drawing.moved_bodies(robot, None)
    (frame,), (tool,) = (
        drawing.root.xpath(f"//site[@name='calibrated_{name}']") for name in ("frame", "tool")
    )
    T = np.linalg.inv(drawing.pose(frame))
    for body, row, value in zip(moved, robot.joints, q, strict=True):
        turn = rotation(2, row.direction * value)
        motion = turn if row.type == "revolute" else translation(0.0, 0.0, row.direction * value)
        T = T @ body.parent_pose @ body.pose @ body.axis_frame @ motion @ np.linalg.inv(body.axis_frame)
    return T @ drawing.pose(tool)


def calibrated(nominal: Robot) -> Robot:
    random = np.random.default_rng(1)
    dh = nominal.dh + random.normal(0, 1e-3, nominal.dh.shape)
    return nominal.with_geometry(dh, random.normal(0, 0.5, 6), random.normal(0, 0.2, 6))


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "ur5e.xml"
    found.write_text(UR5E)
    return found


def assert_exact(robot: Robot, path) -> None:
    q = np.random.default_rng(2).uniform(-2, 2, (5, robot.dof))
    poses = np.stack([pose_in(path, robot, values) for values in q])
    assert_close(poses, forward_kinematics(robot, torch.from_numpy(q)), atol=1e-12)


def test_only_poses_of_bodies_change(path):
    nominal = Robot.load("ur5e")
    robot = calibrated(nominal)
    text = update_mjcf(robot, nominal, path, comments=("by a model",))
    before, after = (etree.fromstring(one.encode()) for one in (UR5E, text))
    moved = [body.get("name") for body in after.iter("body") if body.get("quat") not in (None, "0 0 0 -1")]
    assert moved == ["upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3"]
    assert "<!-- by a model -->" in text
    assert [one.getparent().get("name") for one in after.iter("site")] == ["wrist_3", "base"]
    for root in (before, after):
        for element in [*root.iter("site"), *root.iter(etree.Comment)]:
            element.getparent().remove(element)
        for body in root.iter("body"):
            for key in ("pos", "quat", "euler", "axisangle", "xyaxes"):
                body.attrib.pop(key, None)
    assert [(e.tag, dict(e.attrib)) for e in after.iter()] == [(e.tag, dict(e.attrib)) for e in before.iter()]
    path.write_text(text)
    assert_exact(robot, path)


@pytest.mark.parametrize("name", ["fanuc_r2000", "kiro3", "welding"])
def test_any_robot(name, tmp_path):
    nominal = Robot.load(name)
    path = tmp_path / "drawn.xml"
    path.write_text(urdf_to_mjcf(robot_to_urdf(nominal))[0])
    path.write_text(update_mjcf(calibrated(nominal), nominal, path))
    assert_exact(calibrated(nominal), path)


def test_a_urdf_keeps_inertias_shapes_and_mimics():
    text = """<robot name="r"><link name="a"/><link name="b"><inertial>
      <origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/><mass value="2"/>
      <inertia ixx="1" iyy="2" izz="2.5" ixy="0.1" ixz="0" iyz="0"/></inertial>
      <visual><geometry><mesh filename="package://r/b.stl" scale="1 1 2"/></geometry></visual>
      <visual><geometry><mesh filename="b.dae"/></geometry></visual>
      <collision><geometry><cylinder radius="0.1" length="0.6"/></geometry></collision></link><link name="c"/>
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
      <limit lower="-1" upper="2" effort="1" velocity="1"/></joint>
      <joint name="k" type="continuous"><parent link="b"/><child link="c"/><mimic joint="j" multiplier="-2"/></joint>
      </robot>"""
    mjcf, left_out = urdf_to_mjcf(text)
    root = etree.fromstring(mjcf.encode())
    assert left_out == ("b.dae",)
    (inertial,) = root.iter("inertial")
    assert_close(
        np.array(inertial.get("fullinertia").split(), float), np.array([2, 1, 2.5, -0.1, 0, 0]), atol=1e-15
    )
    assert (inertial.get("pos"), inertial.get("mass")) == ("0.0 0.0 1.0", "2")
    assert [(mesh.get("file"), mesh.get("scale")) for mesh in root.find("asset")] == [("r/b.stl", "1 1 2")]
    assert [(g.get("type"), g.get("size")) for g in root.iter("geom")] == [
        ("mesh", None),
        ("cylinder", "0.1 0.3"),
    ]
    assert [(j.get("axis"), j.get("range")) for j in root.iter("joint") if j.get("axis")] == [
        ("0 1 0", "-1 2"),
        ("1 0 0", None),
    ]
    assert root.find("equality/joint").attrib == {"joint1": "k", "joint2": "j", "polycoef": "0 -2 0 0 0"}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<mujoco", "<robot"),
        ("</mujoco>", ""),
        ('pos="0 0 0.425"', 'pos="0 0 0.43"'),
        ('name="elbow_joint"', 'name="elbow"'),
        ('name="elbow_joint"', 'name="elbow_joint" ref="3"'),
        ('name="elbow_joint"', 'name="elbow_joint" type="slide"'),
        ("<asset>", '<include file="other.xml"/><asset>'),
    ],
)
def test_other_files_are_refused(path, old, new):
    text = UR5E.replace(old, new)
    path.write_text(text.replace("</mujoco>", "</robot>") if new == "<robot" else text)
    nominal = Robot.load("ur5e")
    with refused(RobotError, file=path):
        update_mjcf(copy.deepcopy(nominal), nominal, path)


def test_names_of_joints_do_not_matter_below_a_tip(path):
    path.write_text(UR5E.replace('name="elbow_joint"', 'name="elbow"'))
    nominal = Robot.load("ur5e")
    path.write_text(
        update_mjcf(nominal, nominal, path, tip="wrist_3").replace('name="elbow"', 'name="elbow_joint"')
    )
    assert_exact(nominal, path)
