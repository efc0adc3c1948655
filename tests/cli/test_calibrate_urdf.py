"""A robot from a URDF file all the way: calibrated, out as URDF, read by pytorch-kinematics."""

import json

import numpy as np
import pytest
import torch
from lxml import etree
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.simulated_arm import dh_errors, draw_joints
from testing.urdf import peer_poses

from pisigma.files.errors import RobotError
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_urdf


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    """A UR5 as URDF with a camera in addition to the tool, so that the tool has to be named."""
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    root = etree.fromstring(robot_to_urdf(Robot.load("ur5"), ()).encode())
    elbow = root.findall("joint[@type='revolute']")[2].find("child").get("link")
    root.append(etree.fromstring('<link name="camera"/>'))
    root.append(
        etree.fromstring(
            '<joint name="eye" type="fixed"><origin xyz="0 0 0.1" rpy="0 0 0"/>'
            f'<parent link="{elbow}"/><child link="camera"/></joint>'
        )
    )
    path.write_bytes(etree.tostring(root))
    return path


@pytest.fixture(scope="module")
def tip(urdf):
    """The last link below the last joint."""
    root = etree.parse(str(urdf)).getroot()
    parents = {link.get("link") for link in root.iter("parent")}
    return next(
        link.get("name") for link in root.iter("link") if link.get("name") not in {*parents, "camera"}
    )


@pytest.fixture(scope="module")
def measured(urdf, tip, tmp_path_factory):
    """A file of measured poses of the true arm, and that arm."""
    rng = np.random.default_rng(3)
    robot = Robot.load(urdf, tip=tip)
    true = robot.with_geometry(
        dh=robot.dh + dh_errors(robot, 5e-4, 1e-3, rng),
        base=np.array([0.3, -0.2, 0.1, 0.4, 0.0, -0.2]),
        tool=np.array([0.0, 0.05, 0.1, 0.0, 0.3, 0.0]),
    )
    q = draw_joints(robot, 60, rng)
    T = forward_kinematics(true, q)
    path = tmp_path_factory.mktemp("data") / "poses.csv"
    with no_type_checker():
        Measurements(q=q, position=T[:, :3, 3], rotation=T[:, :3, :3]).write_csv(path, robot)
    return path, true


def test_in_calibrated_and_out_again(run, urdf, tip, measured, tmp_path):
    data, true = measured
    folder, out = tmp_path / "arm", tmp_path / "calibrated.urdf"
    options = ("--out", folder, "--model", "geometric", "--folds", 3, "--json")
    result = run("calibrate", urdf, data, "--tip", tip, *options)
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["cross_validation"]["geometric"]["rms_mm"] < 1e-4
    assert f"--tip {tip}" in (folder / "README.md").read_text()
    exported = run("export", folder, "--format", "urdf", "--like", urdf, "--tip", tip, "--out", out)
    assert exported.exit_code == 0, exported.output
    calibrated = load_model(folder).calibrated
    q = draw_joints(calibrated, 200, np.random.default_rng(4))
    T = forward_kinematics(calibrated, q)
    assert_close(peer_poses(out, "calibrated_tool", q), T, atol=1e-10)
    assert_close(T[:, :3, 3], forward_kinematics(true, q)[:, :3, 3], atol=1e-6)
    assert_close(
        forward_kinematics(Robot.load(out, base="calibrated_frame", tip="calibrated_tool"), q), T, atol=1e-12
    )
    assert torch.isfinite(T).all()


def test_a_tool_without_a_name(refuses, urdf, measured, tmp_path):
    said = refuses("calibrate", urdf, measured[0], "--out", tmp_path / "arm", error=RobotError)
    assert "camera, tool0" in said
    assert not (tmp_path / "arm").exists()


def test_links_of_a_robot_that_is_no_urdf(refuses, measured, tmp_path):
    command = ("calibrate", "ur5", measured[0], "--tip", "tool0", "--out", tmp_path / "arm")
    assert "'ur5'" in refuses(*command, error=RobotError)
