"""Robots drawn by the meshes of their URDF files."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RobotError
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.workbench.viewing.body import MeshBody

trimesh = pytest.importorskip("trimesh", reason="the extra view is not installed")

URDF = """<robot name="arm">
<link name="base"><visual><origin xyz="0 0 0.1"/>
<geometry><cylinder radius="0.1" length="0.2"/></geometry></visual></link>
<joint name="j1" type="revolute"><origin xyz="0 0 0.2"/><parent link="base"/><child link="l1"/><axis xyz="0 0 1"/>
<limit lower="-3" upper="3"/></joint>
<link name="l1"><visual><geometry><mesh filename="package://arm/meshes/link.stl"/></geometry></visual></link>
<joint name="j2" type="prismatic"><origin xyz="0 0 0.5" rpy="1.5 0.2 0"/><parent link="l1"/><child link="l2"/>
<axis xyz="0 0 -1"/><limit lower="-3" upper="3"/></joint>
<link name="l2"><visual><origin xyz="0 0 1" rpy="0 1.57079632679 0"/><geometry>
<mesh filename="../meshes/link.stl" scale="2 1 1"/></geometry></visual></link>
<joint name="j3" type="continuous"><origin xyz="0.3 0 0"/><parent link="l2"/><child link="tip"/>
<axis xyz="0 1 0"/></joint>
<link name="tip"><visual><geometry><sphere radius="0.04"/></geometry></visual>
<visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link></robot>"""


@pytest.fixture
def urdf(tmp_path):
    """A URDF file of a package, with one mesh of 0.1 m x 0.2 m x 0.3 m."""
    (tmp_path / "arm" / "urdf").mkdir(parents=True)
    (tmp_path / "arm" / "meshes").mkdir()
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "arm" / "meshes" / "link.stl")
    path = tmp_path / "arm" / "urdf" / "arm.urdf"
    path.write_text(URDF)
    return path


def test_links_move_with_their_joints(urdf):
    robot = Robot.load(urdf)
    q = np.array([0.4, -0.2, 1.1])
    frames = MeshBody(robot, urdf).frames(dict(zip(("j1", "j2", "j3"), q, strict=True)))
    assert_close(frames["tip"], forward_kinematics(robot, torch.from_numpy(q)), atol=1e-12)
    assert_close(frames["base"], np.eye(4))


def test_meshes_are_in_the_frames_of_their_links(urdf):
    links = MeshBody(Robot.load(urdf), urdf).links
    assert set(links) == {"base", "l1", "l2", "tip"}
    sizes = {name: np.ptp(surface.points, axis=0) for name, surface in links.items()}
    assert_close(sizes["base"], [0.2, 0.2, 0.2], atol=1e-3)
    assert_close(sizes["l1"], [0.1, 0.2, 0.3], atol=1e-6)
    assert_close(sizes["l2"], [0.3, 0.2, 0.2], atol=1e-6)  # twice as long along x, then x becomes -z
    assert_close(links["l2"].points.mean(0), [0.0, 0.0, 1.0], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "line", "value"),
    [
        (("meshes/link.stl", "meshes/absent.stl"), None, "package://arm/meshes/absent.stl"),
        (("../meshes/link.stl", "arm.urdf"), 9, None),
        (('radius="0.04"', 'radius="wide"'), 13, None),
        (('<box size="0.1 0.1 0.1"/>', ""), 14, None),
    ],
)
def test_visuals_that_cannot_be_drawn_are_refused(urdf, change, line, value):
    robot = Robot.load(urdf)
    urdf.write_text(URDF.replace(*change, 1))
    with refused(RobotError, file="arm.urdf", line=line, value=value):
        MeshBody(robot, urdf)


def test_a_file_of_another_robot_is_refused(urdf):
    with refused(RobotError, file="arm.urdf", value="j1, j2, j3"):
        MeshBody(Robot.load("ur5"), urdf)


def test_a_file_without_meshes_is_refused(urdf):
    robot = Robot.load(urdf)
    urdf.write_text(URDF.replace("visual>", "collision>"))
    with refused(RobotError, file="arm.urdf", line=None, value=None):
        MeshBody(robot, urdf)
