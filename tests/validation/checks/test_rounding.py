"""Coarsely rounded values are reported with their step; round values without errors are not."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.closeness import assert_close
from testing.outside_arm import ARMS, OutsideArm

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.checks.rounding import check_rounding, joint_rounding
from pisigma.validation.held_out.diagnostic import Diagnostic


def found(robot: Robot, rows: Measurements) -> list[Diagnostic]:
    return list(check_rounding(checked(GeometricCalibrator(robot), rows)))


def rounded(arm: OutsideArm, degrees: float) -> np.ndarray:
    step = np.where(arm.robot.revolute, np.deg2rad(degrees), degrees * 1e-3)
    return np.round(arm.q / step) * step


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("degrees", [1.0, 0.1])
def test_rounded_joint_values_are_named_with_their_step_and_error(name, degrees):
    arm = OutsideArm(name, 3)
    rows = arm.measured(logged=rounded(arm, degrees))
    (diagnostic,) = found(arm.robot, rows)
    assert diagnostic.cause == "joint_values"
    rounding = joint_rounding(GeometricCalibrator(arm.robot).fit(rows), rows)
    step = np.where(arm.robot.revolute, np.deg2rad(degrees), degrees * 1e-3)
    assert_close(rounding.steps, step)
    moved = arm.true.tip(arm.q)[0] - arm.true.tip(rows.q.numpy())[0]
    assert_close(rounding.rms_error, np.sqrt(np.square(moved).sum(1).mean()), rtol=0.15)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("degrees", [1.0, 0.1, 0.01])
def test_poses_at_round_values_and_fine_steps_are_accepted(name, degrees):
    arm = OutsideArm(name, 5)
    if degrees > 0.05:  # sent to round values
        arm.q = rounded(arm, degrees)
        assert found(arm.robot, arm.measured()) == []
    else:
        assert found(arm.robot, arm.measured(logged=rounded(arm, degrees))) == []


def test_rounded_positions_are_named_with_their_step():
    arm = OutsideArm("kr10", 3)
    rows = arm.measured()
    coarse = replace(rows, position=torch.round(rows.position * 1e3) / 1e3)
    (diagnostic,) = found(arm.robot, coarse)
    assert (diagnostic.cause, diagnostic.values["step_mm"]) == ("positions", 1.0)
    fine = replace(rows, position=torch.round(rows.position * 1e5) / 1e5)
    assert found(arm.robot, fine) == []
