"""`pisigma calibrate --only`: tool, base and hand-eye of robots, models and cells."""

import json
from dataclasses import replace

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


BASE = np.array([0.5, 0.1, 0.2, 0.3, 0.1, -0.1])


def points(count: int) -> Measurements:
    """Return measured positions of the flange of a UR5 on a base."""
    q = torch.from_numpy(np.random.default_rng(1).uniform(-2, 2, (count, 6)))
    return Measurements(q=q, position=forward_kinematics(UR5.with_geometry(base=BASE), q)[:, :3, 3])


def sign(rows: Measurements) -> Measurements:
    """Reverse the sign of the third joint."""
    return replace(rows, q=rows.q * torch.tensor([1, 1, -1, 1, 1, 1]))


def shuffled(rows: Measurements) -> Measurements:
    """Exchange the joint values of rows."""
    return replace(rows, q=rows.q.roll(1, 0))


def stretched(rows: Measurements) -> Measurements:
    """Make all positions 3 % larger."""
    assert rows.position is not None
    return replace(rows, position=1.03 * rows.position)


@pytest.mark.parametrize(
    ("fault", "count", "cause"),
    [
        (None, 4, None),
        (None, 8, None),
        (sign, 8, ("setup_fault", "joint_sign")),
        (shuffled, 4, ("residual", "position")),
        (stretched, 5, ("implausible_errors", "")),
    ],
)
def test_faults_of_the_rows_make_the_result_implausible(fault, count, cause):
    rows = points(count) if fault is None else fault(points(count))
    found = pisigma.calibrate_frame(UR5, rows, "base")
    assert found.trusted == (fault is None)
    assert [(one.kind, one.cause) for one in found.diagnostics[:1]] == ([] if cause is None else [cause])


def test_implausible_result_is_written_only_if_it_is_accepted(run, refuses, tmp_path):
    shuffled(points(4)).write_csv(tmp_path / "points.csv", UR5)
    out = tmp_path / "moved"
    asked = ("calibrate", "ur5", tmp_path / "points.csv", "--only", "base", "--out", out)
    assert run(*asked).exit_code == 3
    assert not out.exists()
    printed = run(*asked, "--accept-implausible", "--json")
    assert printed.exit_code == 0, printed.output
    assert json.loads(printed.stdout)["diagnostics"][0]["severity"] == "implausible"
    assert "**Implausible.**" in (out / "README.md").read_text()


def test_implausible_result_is_not_stored_in_a_cell(run, tmp_path):
    cell = tmp_path / "cell"
    assert run("new", "ur5", "--out", cell).exit_code == 0
    shuffled(points(4)).write_csv(tmp_path / "points.csv", UR5)
    assert run("import", tmp_path / "points.csv", "--cell", cell).exit_code == 0
    assert run("calibrate", cell, "--only", "base").exit_code == 3
    assert not pisigma.Cell.open(cell).history.models()
    assert run("calibrate", cell, "--only", "base", "--accept-implausible").exit_code == 0
    assert len(pisigma.Cell.open(cell).history.models()) == 1


def test_rows_of_the_test_set_are_not_fitted():
    rows = points(8)
    assert rows.position is not None
    position = rows.position + torch.tensor([0.0] * 6 + [0.1] * 2)[:, None]
    marked = replace(rows, position=position, split=("train",) * 6 + ("test",) * 2)
    found = pisigma.calibrate_frame(UR5, marked, "base")
    assert found.summary.rows == 6
    assert_close(found.fit.estimates, BASE, atol=1e-9)
    assert not found.fit.wrong_rows


def test_residuals_of_all_sensors_of_lengths_are_counted():
    """Positions with errors of 0.3 mm and touches without errors, in equal numbers."""
    rows = points(10)
    assert rows.position is not None
    position, touched = rows.position.clone(), torch.arange(10) >= 5
    axis = tuple("xyz"[k % 3] if touch else "" for k, touch in enumerate(touched.tolist()))
    touch = torch.where(touched, position[torch.arange(10), torch.arange(10) % 3], torch.nan)
    position += 3e-4 * torch.from_numpy(np.random.default_rng(0).choice([-1, 1], (10, 3)))
    position[touched] = torch.nan
    found = pisigma.calibrate_frame(
        UR5,
        replace(rows, position=position, touch=touch, touch_axis=axis, frame=("jig",) * 10),
        "base",
    )
    by_sensor = {one.sensor: one.rms for one in found.fit.solved.result().noise}
    expected = np.sqrt((by_sensor["position"] ** 2 + by_sensor["touch"] ** 2) / 2) * 1e3
    assert found.summary.rms_mm is not None
    assert_close(found.summary.rms_mm, expected, rtol=1e-9)
    assert found.summary.rms_mm > 0.1
