"""`pisigma ik --path`: a file of poses solved as one path."""

import csv
import json

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker

from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A model folder of a UR5 as nominal."""
    robot = Robot.load("ur5")
    folder = tmp_path_factory.mktemp("models") / "arm"
    folder.mkdir()
    starts = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (20, 6)))
    with no_type_checker():
        save_model(
            CalibratedModel("arm", "test", robot, None, None, (), starts, calibrated=robot),
            folder,
        )
    return folder


def write(path, q):
    with no_type_checker():
        values = xyz_zyx_from_transform(forward_kinematics(Robot.load("ur5"), torch.from_numpy(q))).numpy()
    rows = np.concatenate([values[:, :3] * 1e3, np.rad2deg(values[:, 3:])], -1).tolist()
    lines = ["x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg", *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


def test_a_path_through_a_singular_pose(run, arm, tmp_path):
    q = np.array([0.3, -1.1, 1.4, -0.9, 0.8, 0.3]) + np.linspace(0, 1, 90)[:, None] * [
        0.4,
        0.2,
        0,
        0,
        -1.6,
        0,
    ]
    poses, out = tmp_path / "poses.csv", tmp_path / "joints.csv"
    write(poses, q)
    result = run("ik", arm, "--poses", poses, "--out", out, "--path", "--json")
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    (switch,) = printed["switches"]
    assert switch["kind"] == "branch"
    assert 44 <= switch["line"] - 2 <= 47
    with out.open() as file:
        rows = list(csv.DictReader(file))
    joints = np.deg2rad([[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows])
    assert_close(joints, q, atol=1e-6)
    spoken = run("ik", arm, "--poses", poses, "--out", out, "--path")
    assert f"line {switch['line']}: " in " ".join(spoken.stdout.split())


def test_a_pose_that_is_out_of_reach(run, arm, tmp_path):
    poses, out = tmp_path / "poses.csv", tmp_path / "joints.csv"
    write(poses, np.tile([0.3, -1.1, 1.4, -0.9, 0.8, 0.3], (5, 1)))
    lines = poses.read_text().splitlines()
    lines[3] = "5000,0,0,0,0,0"
    poses.write_text("\n".join(lines) + "\n")
    result = run("ik", arm, "--poses", poses, "--out", out, "--path", "--json")
    assert result.exit_code == 2
    printed = json.loads(result.stdout)
    assert [(switch["line"], switch["kind"]) for switch in printed["switches"]] == [(4, "gap")]
    assert printed["statuses"] == {"reached": 4, "unreachable": 1}


def test_without_poses(run, arm):
    result = run("ik", arm, "--pose", 1, 2, 3, 4, 5, 6, "--path")
    assert result.exit_code == 2
    assert "--path" in result.stderr
