"""Errors that no calibrated robot has are implausible even if no check explains them; those of healthy arms are not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.models import no_type_checker
from testing.outside_arm import ARMS, OutsideArm
from testing.report import bare_summary

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import direction_by_zero_parameter
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.robot_class import HOBBY, INDUSTRIAL, SERVO
from pisigma.validation.checks import prior_ratio
from pisigma.validation.checks.prior_ratio import check_joint_zero
from pisigma.validation.checks.unexplained import check_unexplained
from pisigma.validation.held_out.calibration_summary import CalibrationSummary, ParameterFigures
from pisigma.validation.report import arm_in_images


@pytest.mark.parametrize("name", ARMS)
def test_errors_of_unknown_cause_are_implausible(name):
    arm = OutsideArm(name, 3)
    off = np.random.default_rng(0).normal(0, 3e-3, arm.q.shape) * arm.robot.reach
    rows = arm.measured(logged=arm.q + off)
    check = checked(GeometricCalibrator(arm.robot), rows)
    assert [one.severity for one in check_unexplained(check)] == ["implausible"]
    stated = replace(rows, sigma_position=torch.full((100,), 5e-3 * arm.robot.reach, dtype=torch.float64))
    assert list(check_unexplained(checked(GeometricCalibrator(arm.robot), stated))) == []


def test_errors_of_servos_are_plausible_for_arms_of_servos_only():
    arm = OutsideArm(ARMS[0], 3)
    off = np.random.default_rng(0).normal(0, 15e-3, arm.q.shape)
    rows, found = arm.measured(logged=arm.q + off), {}
    for maker in ("Niryo", "TheRobotStudio"):
        check = checked(GeometricCalibrator(replace(arm.robot, maker=maker)), rows)
        found[maker] = [one.values["rms_mm"] / (check.robot.reach * 1e3) for one in check_unexplained(check)]
    (share,) = found.pop("Niryo")
    assert HOBBY.max_calibrated_error_per_reach < share < SERVO.max_calibrated_error_per_reach
    assert found == {"TheRobotStudio": []}


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("rows", [25, 100])
def test_healthy_arms_are_plausible(name, rows):
    arm = OutsideArm(name, 6, rows)
    check = checked(GeometricCalibrator(arm.robot), arm.measured())
    assert [*check_unexplained(check), *check_joint_zero(check)] == []


def test_errors_of_zeros_count_in_the_direction_of_the_joint(monkeypatch):
    robot = Robot.load("fanuc_r2000")
    assert direction_by_zero_parameter(robot) == {f"theta_{k}": 1 if k < 3 else -1 for k in range(1, 7)}
    theta = SimpleNamespace(name="theta_3", free=True, change=np.deg2rad(2.0), standard_error=1e-4)
    found = SimpleNamespace(
        robot=robot, rows=None, robot_class=INDUSTRIAL, geometric=SimpleNamespace(parameters=[theta])
    )
    monkeypatch.setattr(prior_ratio, "setup_diagnostics", lambda *_: ())
    figures = ParameterFigures(
        name="theta_3",
        unit="deg",
        nominal=0,
        estimated=2,
        change=2,
        standard_error=0.01,
        remark="",
        short_remark="",
    )
    summary = bare_summary(parameters=(figures,))
    monkeypatch.setattr(CalibrationSummary, "read", lambda _: summary)
    with no_type_checker():
        assert next(check_joint_zero(found)).values["change_deg"] == pytest.approx(-2.0)
        assert [one.zero_shift_deg for one in arm_in_images._zeros(SimpleNamespace(robot=robot))] == [-2.0]


@pytest.mark.parametrize(("degrees", "joints"), [(0.0, []), (1.0, [2]), (-1.0, [2])])
def test_a_joint_whose_zero_is_off_is_named_where_base_and_tool_hide_it(shared_data, degrees, joints):
    robot = Robot.load("ur5")
    rows = Measurements.read_csv(shared_data / "ur5/grid.csv", robot)
    rows = rows.select(torch.arange(0, rows.rows, 10))
    q = rows.q.clone()
    q[:, 1] += np.deg2rad(degrees)
    found = list(check_joint_zero(checked(GeometricCalibrator(robot), replace(rows, q=q))))
    assert [one.severity for one in found] == ["warning"] * len(joints)
    assert [one.values["joint"] for one in found] == [str(joint) for joint in joints]
