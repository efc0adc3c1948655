"""`pisigma calibrate` of a cell of several arms: a model for each, frames.yaml, and what is refused."""

import hashlib
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import Result
from testing.closeness import assert_close
from testing.refusals import refused
from testing.two_arms import BASES, TIP, UR5, measured_positions, pose_of, touching_rows

from pisigma.files.errors import (
    AcceptanceError,
    IdentificationError,
    MeasurementError,
    OutputError,
    PlanningError,
    SettingError,
)
from pisigma.files.model_files import COMPILED, DESCRIPTION, model_hash
from pisigma.files.yaml_file import read_yaml
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_document import write_document
from pisigma.model.folder.model_folder import load_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import pose_error, transform_from_xyz_zyx
from pisigma.validation.held_out.arms_summary import ArmsSummary
from pisigma.workflow.arms.calibrate_arms import (
    FRAMES_FILE,
    Arm,
    ArmsCalibration,
    calibrate_arms,
    calibrate_arms_of_cell,
    posterior_of,
)
from pisigma.workflow.cell.transfer import upgrade
from pisigma.workflow.settings.calibration import CalibrationSettings

CELL = """arms:
  left: {robot: ur5, sessions: [sessions/left.csv]}
  right: {robot: ur5, sessions: [sessions/right.csv]}
calibrate: {model: geometric, folds: 0}
"""
QUICK = CalibrationSettings(model="geometric", folds=0)


@pytest.fixture(scope="module")
def calibrated(run, tmp_path_factory) -> tuple[Path, Result]:
    """The folder of a calibrated cell of two arms, and what the command printed."""
    folder = tmp_path_factory.mktemp("arms")
    (folder / "sessions").mkdir()
    (folder / "cell.yaml").write_text(CELL)
    for number, name in enumerate(("left", "right")):
        measured_positions(number, 0).write_csv(folder / "sessions" / f"{name}.csv", UR5)
    return folder, run("calibrate", folder, "--json")


def moved(rows: Measurements, frame: str) -> Measurements:
    """Move a frame by 1 mm."""
    there = torch.tensor([[name == frame] for name in rows.frame])
    return replace(rows, position=rows.position + 1e-3 * there)


@pytest.fixture(scope="module")
def disagreeing() -> ArmsCalibration:
    """Arms between whose measurements a frame moved."""
    left, right = measured_positions(0, 0), moved(measured_positions(1, 0), "jig")
    return calibrate_arms([Arm("left", UR5, left, QUICK), Arm("right", UR5, right, QUICK)])


def test_every_arm_has_a_model_and_the_file_has_their_bases(calibrated):
    folder, result = calibrated
    printed: dict[str, Any] = json.loads(result.stdout)
    models = Path(printed["folder"])
    assert result.exit_code == 0
    assert models.parent == folder / "models"
    assert sorted(path.name for path in models.iterdir()) == [FRAMES_FILE, "left", "right"]
    written = read_yaml(models / FRAMES_FILE, ArmsSummary, PlanningError)
    for one in written.arms:
        assert one.sha256 == model_hash(models / one.name)
        assert set(load_model(models / one.name).bases) == {"hall", "jig"}
    (base,) = written.bases
    values = [base.x_mm, base.y_mm, base.z_mm, base.roll_deg, base.pitch_deg, base.yaw_deg]
    found = torch.tensor([v / 1e3 for v in values[:3]] + list(np.deg2rad(values[3:])), dtype=torch.float64)
    shown = torch.tensor([1e3] * 3 + [180 / np.pi] * 3)
    error = pose_error(pose_of(BASES[1]), transform_from_xyz_zyx(found)) * shown
    covariance = torch.tensor(base.covariance, dtype=torch.float64)
    assert float(error @ torch.linalg.solve(covariance, error)) < 17  # 99 % of chi-squared
    assert_close(
        covariance.diagonal().sqrt(), torch.tensor(base.standard_errors, dtype=torch.float64), rtol=1e-9
    )
    assert (written.degrees_of_freedom, len(written.diagnostics), written.indeterminate_sums) == (6, 0, ())


def test_frame_that_moved_between_the_arms_is_not_trusted(disagreeing, tmp_path):
    (first, *others) = disagreeing.summary.diagnostics
    assert not disagreeing.trusted
    assert {first.values["name"], *(one.values["name"] for one in others)} == {"hall", "jig"}
    with refused(AcceptanceError):
        disagreeing.save(tmp_path / "models")
    assert not (tmp_path / "models").exists()


def test_accepted_arms_are_written_once(disagreeing, tmp_path):
    written = disagreeing.save(tmp_path / "models", accept_implausible=True)
    assert read_yaml(tmp_path / "models" / FRAMES_FILE, ArmsSummary, PlanningError) == written
    with refused(OutputError, file=str(tmp_path / "models")):
        disagreeing.save(tmp_path / "models", accept_implausible=True)


def test_frames_name_models_that_were_upgraded(disagreeing, tmp_path):
    (tmp_path / "cell.yaml").write_text("arms: {}\n")
    models = tmp_path / "models" / "2026-11-27"
    disagreeing.save(models, accept_implausible=True)
    frames, left, other = models / FRAMES_FILE, models / "left", b"of another version"
    (left / COMPILED).write_bytes(other)
    before = model_hash(left)
    text = (left / DESCRIPTION).read_text().partition("compiled_sha256:")[0]
    write_document(text, hashlib.sha256(other).hexdigest(), left / DESCRIPTION)
    frames.write_text(frames.read_text().replace(before, model_hash(left)))
    done = upgrade(tmp_path)
    assert [(one.name, len(one.changes)) for one in done.models] == [("left", 1), ("right", 0)]
    assert {one.sha256 for one in read_yaml(frames, ArmsSummary, PlanningError).arms} == {
        model_hash(models / name) for name in ("left", "right")
    }


def test_sum_of_base_and_tool_is_named():
    """All axes of a SCARA are parallel, so its base along z and the length of its tool have the same effect."""
    scara = Robot.load("kiro3")
    q = torch.from_numpy(
        np.random.default_rng(0).uniform(*np.clip(scara.limits, -2.2, 2.2).T, (30, scara.dof))
    )
    arms = []
    for name, length in (("left", 0.0), ("right", 0.005)):
        longer = scara.with_geometry(tool=scara.tool + np.array([0, 0, length, 0, 0, 0]))
        rows = Measurements(q=q, position=forward_kinematics(longer, q)[:, :3, 3], frame=("hall",) * len(q))
        arms.append(Arm(name, scara, rows, QUICK))
    found = calibrate_arms(arms)
    (base,) = found.summary.bases
    assert_close(base.z_mm, 5.0, atol=0.01)
    assert len(found.summary.indeterminate_sums) == 2
    assert all("tool_z" in sentence for sentence in found.summary.indeterminate_sums)
    assert set(found.summary.indeterminate_sums) <= set(found.warnings)


def test_other_commands_ask_for_one_arm(calibrated, refuses):
    folder, _ = calibrated
    for command in ("status", "monitor", "verify", "plan"):
        refuses(command, folder, error=PlanningError, column="arms", line=1)


def test_options_of_one_robot_are_refused(calibrated, run):
    folder, _ = calibrated
    assert run("calibrate", folder, "--only", "base").exit_code == 2
    assert run("calibrate", folder, folder / "sessions" / "left.csv").exit_code == 2


@pytest.mark.parametrize(
    ("old", "new", "error", "fields"),
    [
        (r", sessions: .sessions/left.csv.", "", PlanningError, {"line": 2}),
        ("sessions/left.csv", "../left.csv", PlanningError, {"value": "../left.csv"}),
        ("sessions/left.csv", "sessions/none.csv", MeasurementError, {}),
        ("folds: 0", "fold: 0", SettingError, {"column": "calibrate.fold"}),
        (r"  right.*\n", "", IdentificationError, {"option": "arms", "value": 1}),
        ("  right:", "  right arm:", IdentificationError, {"option": "arms", "value": "right arm"}),
    ],
)
def test_faulty_files_are_refused(calibrated, tmp_path, old, new, error, fields):
    folder, _ = calibrated
    text = re.sub(old, new, CELL, count=1)
    assert text != CELL
    (tmp_path / "cell.yaml").write_text(text)
    shutil.copytree(folder / "sessions", tmp_path / "sessions")
    (tmp_path / "left.csv").touch()
    with refused(error, **fields):
        calibrate_arms_of_cell(tmp_path)


def test_arms_that_touch_are_connected(tmp_path):
    (tmp_path / "sessions").mkdir()
    lines = ["arms:"]
    for number, (name, frame) in enumerate((("left", "hall"), ("right", "jig"))):
        measured_positions(number, 0, (frame,)).write_csv(tmp_path / "sessions" / f"{name}.csv", UR5)
        touching_rows(number, 0, "tip").write_csv(tmp_path / "sessions" / f"{name}_touches.csv", UR5)
        files = f"sessions: [sessions/{name}.csv], touches: [sessions/{name}_touches.csv]"
        lines.append(f"  {name}: {{robot: ur5, {files}}}")
    (tmp_path / "cell.yaml").write_text("\n".join([*lines, "calibrate: {model: geometric, folds: 0}"]))
    found, folder = calibrate_arms_of_cell(tmp_path)
    assert folder is not None
    written = read_yaml(folder / FRAMES_FILE, ArmsSummary, PlanningError)
    (base,) = written.bases
    assert_close([base.x_mm, base.y_mm, base.z_mm], BASES[1][:3] * 1e3, atol=0.5)
    assert [(one.kind, one.name) for one in written.shared] == [("touch", f"touch {k}") for k in range(20)]
    for tip in written.tips:
        assert_close([tip.x_mm, tip.y_mm, tip.z_mm], TIP[:3] * 1e3, atol=4 * max(tip.standard_errors))
    assert found.trusted
    assert [one["name"] for one in found.to_json()["tips"]] == ["tip", "tip"]


def test_touch_without_name_or_standard_deviation_is_refused(disagreeing):
    touching = touching_rows(0, 0)
    unnamed = replace(touching, socket=("", *("" if touching.socket is None else touching.socket[1:])))
    for rows in (unnamed, replace(touching, sigma_position=None)):
        with refused(MeasurementError):
            posterior_of(Arm("left", UR5, rows, QUICK, rows), disagreeing.calibrations["left"], ())
