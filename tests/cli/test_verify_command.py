"""`pisigma verify`: exit status, figures, one JSON object."""

import hashlib
import json

import pytest
import torch
from testing.models import hand_made_model, joints_around, no_type_checker
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.forward import forward_kinematics


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Positions of the hand-made kiro3 with its correction, without it, and with a sign turned."""
    folder = tmp_path_factory.mktemp("measured")
    model = hand_made_model("kiro3")
    q = joints_around("kiro3", 40, seed=5, spread=0.2)
    with no_type_checker():
        right, nominal = model.forward(q)[:, :3, 3], forward_kinematics(model.robot, q)[:, :3, 3]
    turned = q * torch.tensor([1, -1, 1, 1])
    moved = right[:, [1, 0, 2]] * torch.tensor([1.0, -1.0, 1.0]) + 0.3  # a quarter turn about z, and away
    cases = (("good", q, right), ("nominal", q, nominal), ("sign", turned, right), ("moved", q, moved))
    for name, joints, position in cases:
        revolute = list(model.robot.revolute)
        Measurements(q=joints, position=position).write_csv(folder / f"{name}.csv", revolute=revolute)
    return folder


def test_measurements_that_are_explained_better(run, models, files):
    result = run("verify", models / "kiro3", files / "good.csv", "--json")
    assert result.exit_code == 0
    assert result.stderr == ""
    printed = json.loads(result.stdout)
    assert printed["accepted"] is True
    assert printed["verdict"] == "better"
    assert printed["setup_faults"] == []
    assert [model["name"] for model in printed["models"]] == ["nominal", "corrected"]
    assert printed["models"][1]["mean_mm"] < printed["models"][0]["mean_mm"]
    assert printed["ratio"] < 0.1
    shown = run("verify", models / "kiro3", files / "good.csv")
    assert shown.exit_code == 0
    assert_screen(
        shown.stdout, "Trust: yes", "position, RMS", "position, 95 %", "position, largest", "from nominal"
    )
    whole = run("verify", models / "kiro3", files / "good.csv", "--verbose")
    assert_screen(whole.stdout, "better in", "Wilcoxon", verbose=True)


def test_the_nominal_robot_ends_with_status_3(run, models, files):
    result = run("verify", models / "kiro3", files / "nominal.csv", "--json")
    assert result.exit_code == 3
    printed = json.loads(result.stdout)
    assert printed["accepted"] is False
    assert printed["setup_faults"][0]["kinds"] == ["correction"]
    assert result.stderr == f"pisigma: {printed['sentence']}\n"
    assert printed["verdict"] == "not_better"


def test_a_setup_fault_is_named(run, models, files):
    result = run("verify", models / "kiro3", files / "sign.csv")
    assert result.exit_code == 3
    assert_screen(result.stdout, "Trust: no: the sign of joint 2 is reversed")
    assert "joint 2" in result.stderr


def test_a_moved_sensor(run, models, files):
    result = run("verify", models / "kiro3", files / "moved.csv")
    assert result.exit_code == 3
    assert "with --fit-frame" in " ".join(result.stdout.split())
    result = run("verify", models / "kiro3", files / "moved.csv", "--fit-frame")
    assert result.exit_code == 0
    assert "Warning: " in result.stdout  # these rows determine the frame too
    result = run("evaluate", models / "kiro3", files / "moved.csv", "--fit-frame", "--max-p95-mm", "0.001")
    assert result.exit_code == 0
    assert "Warning: " in result.stdout  # these rows determine the frame too
    result = run("evaluate", models / "kiro3", files / "moved.csv", "--max-p95-mm", "0.001")
    assert result.exit_code == 3


def test_things_at_fault(refuses, models, files, tmp_path):
    refuses("verify", tmp_path / "nothing", files / "good.csv", error=ModelError)
    refuses("verify", models / "kiro3", tmp_path / "no.csv", error=MeasurementError, file="no.csv")
    (tmp_path / "few.csv").write_text("q1_deg,x_mm,y_mm,z_mm\n1,2,3,4\n")
    refuses("verify", models / "kiro3", tmp_path / "few.csv", error=MeasurementError, file="few.csv")


def test_the_model_that_is_meant(run, refuses, models, files):
    sha256 = hashlib.sha256((models / "kiro3" / "model.yaml").read_bytes()).hexdigest()
    for command in ("verify", "evaluate"):
        assert run(command, models / "kiro3", files / "good.csv", "--sha256", sha256).exit_code == 0
        refuses(command, models / "kiro4", files / "good.csv", "--sha256", sha256, error=ModelError)
    several = models / "kiro3", "geometric", models / "kiro3", files / "good.csv"
    result = run("evaluate", *several, "--sha256", sha256)
    assert result.exit_code == 2
    assert "'--sha256'" in result.stderr
