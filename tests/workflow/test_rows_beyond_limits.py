"""Every command that reads rows accepts those outside the nominal joint limits, and names joint and row."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.fleet_robots import few_steps
from testing.identified import geometric_model
from testing.models import no_type_checker

from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.writing import robot_to_yaml
from pisigma.workflow.cell.new_cell import NewCell
from pisigma.workflow.compare import compare
from pisigma.workflow.evaluate import evaluate
from pisigma.workflow.fleet.manifest import new_cells
from pisigma.workflow.fleet.prior import estimate_fleet_prior
from pisigma.workflow.monitor import monitor
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.report import report
from pisigma.workflow.verify import verify


@pytest.fixture(scope="module")
def narrow(tmp_path_factory) -> tuple[Path, Measurements]:
    """A model whose third joint has a smaller nominal range than its rows use, and such rows."""
    model = geometric_model("ur10")
    rows = list(model.robot.rows)
    rows[2] = dataclasses.replace(rows[2], lower=-1.0, upper=1.0)
    nominal = dataclasses.replace(model.robot, rows=tuple(rows))
    assert model.calibrated is not None
    calibrated = dataclasses.replace(model.calibrated, rows=tuple(rows))
    folder = tmp_path_factory.mktemp("models") / "narrow"
    folder.mkdir()
    save_model(dataclasses.replace(model, robot=nominal, calibrated=calibrated), folder)
    q = torch.from_numpy(np.random.default_rng(0).uniform(-0.9, 0.9, (30, 6)))
    q[4, 2] = 1.2
    rows = Measurements(q=q, position=forward_kinematics(calibrated, q)[:, :3, 3], source="rows.csv")
    return folder, rows


def other(model: Path) -> Path:
    """A second model of the same robot."""
    folder = model.parent / "other"
    if not folder.exists():
        folder.mkdir()
        save_model(dataclasses.replace(load_model(model), name="other"), folder)
    return folder


@pytest.mark.parametrize(
    "command",
    [
        lambda m, r: verify(m, r).warnings,
        lambda m, r: evaluate(m, r).warnings,
        lambda m, r: compare(m, other(m), r).warnings,
        lambda m, r: report(m, r).content.remarks,
    ],
    ids=["verify", "evaluate", "compare", "report"],
)
def test_the_warning_names_joint_and_row(command, narrow):
    model, rows = narrow
    warnings = [one for one in command(model, rows) if "'theta_3'" in one]
    assert len(warnings) == 1
    assert str(rows.place(4)) in warnings[0]


def test_monitor_and_recalibrate_warn_and_recalibrate_widens(tmp_path):
    model, rows = original_model(), rows_after_change(20, 7)
    model, widest = narrow_model(model), float(rows.q[:, 2].abs().max())
    assert model.robot.limits[2, 1] < widest
    with no_type_checker():
        monitored = monitor(model, [rows])
        made = recalibrate(model, rows)
        made.save(tmp_path / "arm")
        loaded = load_model(tmp_path / "arm")
    for warnings in (monitored.warnings, made.warnings):
        assert sum("'theta_3'" in one for one in warnings) == 1
    assert abs(loaded.robot.limits[2]).max() >= widest


def test_a_fleet_prior_warns_and_widens(tmp_path):
    arm = narrow_model(original_model()).robot
    (tmp_path / "arm.yaml").write_text(robot_to_yaml(arm))
    lines = ["id,robot,data"]
    for number in range(5):
        rows = rows_after_change(40, number)
        rows.write_csv(tmp_path / f"r{number}.csv", arm)
        lines.append(f"r{number},arm.yaml,r{number}.csv")
    (tmp_path / "fleet.csv").write_text("\n".join(lines) + "\n")
    with no_type_checker(), few_steps():
        new_cells(tmp_path / "fleet.csv", tmp_path / "cells", NewCell(""))
        prior = estimate_fleet_prior(tmp_path / "cells")
    assert sum("'theta_3'" in one for one in prior.summary.warnings) == 5
    assert abs(prior.model.robot.limits[2]).max() > abs(arm.limits[2]).max()


def narrow_model(model: CalibratedModel) -> CalibratedModel:
    """Return the model with nominal limits of +-166 deg for its third joint."""

    def narrowed(robot: Robot) -> Robot:
        rows = list(robot.rows)
        rows[2] = dataclasses.replace(rows[2], lower=-2.9, upper=2.9)
        return dataclasses.replace(robot, rows=tuple(rows))

    assert model.calibrated is not None
    return dataclasses.replace(model, robot=narrowed(model.robot), calibrated=narrowed(model.calibrated))
