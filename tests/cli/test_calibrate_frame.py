"""`pisigma calibrate --only`: tool, base and hand-eye of robots, models and cells."""

import json

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.identified import geometric_model
from testing.models import hand_made_model
from testing.touches import TIP, random_noise, touches, touching_joints

import pisigma
from pisigma.files.errors import IdentificationError, ModelError
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

UR5 = Robot.load("ur5")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with touches.csv, whose third row is wrong."""
    folder = tmp_path_factory.mktemp("frames")
    touches(touching_joints(6), random_noise(6, 2, wrong=2)).write_csv(folder / "touches.csv", UR5)
    return folder


def test_tool_of_a_robot_from_touches(run, folder):
    out = folder / "tipped"
    printed = run("calibrate", "ur5", folder / "touches.csv", "--only", "tool", "--out", out)
    assert printed.exit_code == 0, printed.output
    assert "touches.csv, line 4 was left out" in printed.stdout.replace("\n  ", " ")
    assert "standard error" in printed.stdout
    again = run(
        "calibrate", "ur5", folder / "touches.csv", "--only", "tool", "--out", out, "--overwrite", "--json"
    )
    figures = json.loads(again.stdout)
    assert [one["row"] for one in figures["outliers"]] == [2]
    assert [one["unit"] for one in figures["coordinates"]] == ["mm"] * 3
    for one, true in zip(figures["coordinates"], TIP[:3] * 1e3, strict=True):
        assert abs(one["estimated"] - true) < 5 * one["standard_error"] < 0.5
    model = load_model(out)
    assert_close(model.robot.dh, UR5.dh)
    assert_close(model.robot.tool[:3], TIP[:3], atol=2e-4)
    assert "| tool_x | mm |" in (out / "README.md").read_text()


def test_base_of_a_calibrated_model_keeps_its_arm_and_tool(run, tmp_path):
    model = geometric_model("ur10", Robot.load("ur10").with_geometry(tool=TIP))
    (tmp_path / "arm").mkdir()
    save_model(model, tmp_path / "arm")
    base = np.array([0.5, 0.1, 0.2, 0.3, 0.1, -0.1])
    true = model.calibrated.with_geometry(base=base)
    q = torch.from_numpy(np.random.default_rng(0).uniform(-2, 2, (5, 6)))
    rows = Measurements(q=q, position=forward_kinematics(true, q)[:, :3, 3])
    rows.write_csv(tmp_path / "points.csv", model.robot)
    moved = run(
        "calibrate", tmp_path / "arm", tmp_path / "points.csv", "--only", "base", "--out", tmp_path / "moved"
    )
    assert moved.exit_code == 0, moved.output
    found = load_model(tmp_path / "moved")
    assert_close(found.calibrated.dh, model.calibrated.dh, atol=1e-15)
    assert_close(found.calibrated.base, base, atol=1e-8)
    assert_close(found.robot.tool, TIP)
    assert_close(poses_of_rows(found, rows)[:, :3, 3], rows.position, atol=1e-8)
    assert found.metrics["parent"]["name"] == model.name


def test_what_does_not_fit_is_refused(run, refuses, folder):
    rows, out = folder / "touches.csv", ("--out", folder / "no")
    refuses(
        "calibrate",
        "ur5",
        rows,
        "--only",
        "tool",
        "--folds",
        2,
        *out,
        error=IdentificationError,
        option="folds",
    )
    with pytest.raises(ModelError):
        pisigma.calibrate_frame(
            hand_made_model("ur10"), touches(touching_joints(6), random_noise(6, 0)), "tool"
        )


def test_tool_of_a_cell_is_stored_as_its_model(run, folder):
    cell = folder / "cell"
    assert run("new", "ur5", "--out", cell).exit_code == 0
    assert run("import", folder / "touches.csv", "--cell", cell).exit_code == 0
    printed = run("calibrate", cell, "--only", "tool", "--json")
    assert printed.exit_code == 0, printed.output
    figures = json.loads(printed.stdout)
    assert_close(load_model(figures["model"]).robot.tool[:3], TIP[:3], atol=2e-4)
    (entry,) = pisigma.Cell.open(cell).history.models()
    assert figures["model"].endswith(entry.name)
    assert entry.remark.startswith("tool")
