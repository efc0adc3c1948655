"""`pisigma ik` where not all axes of the tool count."""

import csv
import json

import pytest
import torch
from testing.calibrated_arm import calibrated_arm, joints_of
from testing.models import no_type_checker
from testing.pose_files import write_poses

from pisigma.model.folder.model_folder import save_model
from pisigma.robot.se3 import xyz_zyx_from_transform


@pytest.fixture(scope="module")
def calibrated_folder(tmp_path_factory):
    """A calibrated UR5 as a model folder."""
    folder = tmp_path_factory.mktemp("models") / "ur5"
    folder.mkdir()
    with no_type_checker():
        save_model(calibrated_arm("ur5", hybrid=False), folder)
    return folder


def test_axes_of_the_tool_that_do_not_count(run, calibrated_folder, tmp_path):
    model = calibrated_arm("ur5", hybrid=False)
    T = model.forward(joints_of(model.robot, 3, seed=4, share=0.8))
    turned = T.clone()
    turned[:, :3, 0], turned[:, :3, 1] = T[:, :3, 1], -T[:, :3, 0]
    rows = [[*(v[:3] * 1e3).tolist(), *torch.rad2deg(v[3:]).tolist()] for v in xyz_zyx_from_transform(turned)]
    write_poses(tmp_path / "poses.csv", rows)
    options = ("--ignore-axes", "yaw", "--tolerance-mm", "0.05")
    result = run(
        "ik", calibrated_folder, "--poses", tmp_path / "poses.csv", "--out", tmp_path / "q.csv", *options
    )
    assert result.exit_code == 0, result.output
    lines = list(csv.DictReader((tmp_path / "q.csv").read_text().splitlines()))
    assert all(float(line["position_residual_mm"]) < 1e-6 for line in lines)
    result = run("ik", calibrated_folder, "--pose", *rows[0], "--ignore-axes", "yaw", "--json")
    (solution,) = json.loads(result.stdout)["solutions"]
    assert solution["ignored_axes"] == ["yaw"]
    assert solution["rotation_residual_deg"] < 1e-8
    shown = run("ik", calibrated_folder, "--pose", *rows[0], "--ignore-axes", "yaw").stdout
    assert any(line.endswith(": yaw.") for line in shown.splitlines())
    for wrong, words in (
        (("--ignore-axes", "rol"), "'rol'"),
        (("--tolerance-mm", "small"), "'small'"),
        (("--elbow-deg", "30"), "elbow"),
    ):
        refused = run("ik", calibrated_folder, "--pose", *rows[0], *wrong)
        assert refused.exit_code == 2
        assert words in " ".join(refused.output.split())
