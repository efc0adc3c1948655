"""A calibration with rows outside the nominal joint limits."""

import dataclasses

import numpy as np
import torch
from testing.closeness import assert_close

import pisigma
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings


def test_limits_of_the_model_include_the_rows_so_that_corrected_ik_reaches_them(tmp_path):
    arm = Robot.load("ur10")
    narrow = (*arm.rows[:2], dataclasses.replace(arm.rows[2], lower=-1.0, upper=1.0), *arm.rows[3:])
    nominal = dataclasses.replace(arm, rows=narrow)
    q = np.random.default_rng(0).uniform(-1.2, 1.2, (40, 6))
    position = forward_kinematics(arm, torch.from_numpy(q))[:, :3, 3] + torch.tensor([0.1, 0.2, 0.3])
    rows = Measurements(q=torch.from_numpy(q), position=position, source="rows.csv")
    made = calibrate(nominal, rows, CalibrationSettings(model="geometric", folds=0))
    assert sum("joint 'theta_3'" in one for one in made.warnings) == 1
    assert_close(made.model.robot.limits[2], [q[:, 2].min(), q[:, 2].max()], atol=1e-12)
    made.save(tmp_path / "arm")
    solver = pisigma.load(tmp_path / "arm")
    farthest = torch.from_numpy(q[[np.abs(q[:, 2]).argmax()]])
    T = solver.model.forward(farthest)
    assert_close(solver(T, near=farthest).q, farthest, atol=1e-6)
