"""`pisigma robots`: the catalogue, and controllers' own files as robot files."""

import json

import torch
from testing.closeness import assert_close
from testing.coupled import COUPLED, coupled_robot
from testing.identified import geometric_model

from pisigma.files.errors import RobotError, UnknownRobotError
from pisigma.model.folder.model_folder import save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_urdf

TWO_ENDS = """<link name="camera"/>
<joint name="beside" type="fixed"><parent link="link_1"/><child link="camera"/></joint>
</robot>"""


def test_a_calibration_goes_to_the_controller_and_comes_back(run, refuses, tmp_path):
    model = geometric_model("ur10")
    (tmp_path / "arm").mkdir()
    save_model(model, tmp_path / "arm")
    conf, out = tmp_path / "calibration.conf", tmp_path / "arm.yaml"
    written = run("export", tmp_path / "arm", "--format", "ur-calibration", "--out", conf, "--json")
    stated = json.loads(written.stdout)
    assert stated["off_the_whole_model"]["max_mm"] < 1e-6 < stated["robot_as_drawn"]["mean_mm"]
    assert any("forum.universal-robots.com" in remark for remark in stated["remarks"])
    read = run("robots", "--read", conf, "--like", "ur10", "--out", out)
    assert (read.exit_code, read.stdout.count("Warning")) == (0, 0)
    assert str(out) in read.stdout
    q = torch.rand((50, 6), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert model.calibrated is not None
    assert_close(forward_kinematics(Robot.load(out), q), forward_kinematics(model.calibrated, q), atol=1e-9)
    summary = json.loads(run("robots", "--read", conf, "--like", "ur10", "--out", out, "--json").stdout)
    change = summary.pop("change")
    assert summary.pop("frames")["base"]["roll_deg"] == 0
    assert any("calibration_test.cpp" in remark for remark in summary.pop("remarks"))
    assert summary == {"file": str(out), "robot": "ur10", "joints": 6, "warnings": []}
    assert 0.1 < change["mean_mm"] < change["max_mm"] < 20
    conf.write_text(conf.read_text().replace("delta_a = [", "delta_a = [0.02, 0, 0, 0, 0, 0] # ["))
    written = out.read_bytes()
    refuses("robots", "--read", conf, "--like", "ur10", "--out", out, error=RobotError)
    assert out.read_bytes() == written
    wide = ("--max-change-mm", "1e5", "--json")
    farther = json.loads(run("robots", "--read", conf, "--like", "ur10", "--out", out, *wide).stdout)
    assert farther["change"]["mean_mm"] > 5
    drawn = robot_to_urdf(Robot.load("ur10")).replace("</robot>", TWO_ENDS)
    (tmp_path / "arm.urdf").write_text(drawn)
    arguments = ("robots", "--read", conf, "--like", tmp_path / "arm.urdf", "--out", out, *wide)
    refuses(*arguments, stdout=None, error=RobotError)
    assert json.loads(run(*arguments, "--base", "base_link", "--tip", "tool0").stdout)["joints"] == 6
    refuses("robots", "--read", conf)
    refuses("robots", "--read", out, "--like", "ur10", "--out", out)


def test_a_description_is_checked_at_the_pendant(run, refuses, tmp_path):
    file = tmp_path / "coupled.yaml"
    file.write_text(COUPLED)
    printed = json.loads(run("robots", "--check", file, "--json").stdout)
    assert [pose["axis"] for pose in printed["poses"]] == [
        None,
        *(axis.name for axis in coupled_robot().axes),
    ]
    second = printed["poses"][2]
    assert (second["value_deg"], second["within_limits"]) == (76.0, True)
    T = forward_kinematics(coupled_robot(), torch.deg2rad(torch.tensor([0, 76.0, 76.0, 0, 0, 0]).double()))
    assert_close([second[f"{axis}_mm"] / 1e3 for axis in "xyz"], T[:3, 3], atol=1e-12)
    shown = run("robots", "--check", "ur5").stdout
    assert "theta_3" in shown
    assert "-817.25" in shown
    assert "inside" in shown
    assert all(len(line) <= 80 for line in run("robots", "--check", "ur10").stdout.splitlines())
    refuses("robots", "--check", "nothing", error=UnknownRobotError)
