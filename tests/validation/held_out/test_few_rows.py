"""Few rows have to show that a fitted arm is better than the nominal one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.models import no_type_checker
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.held_out.calibration_validation import pose_errors_of
from pisigma.validation.held_out.few_rows import fit_if_better
from pisigma.validation.held_out.trained_calibrations import base_and_tool_calibrator


def nothing(what: str) -> None:
    """No progress is shown."""


def test_few_poses_are_at_most_a_little_worse_than_the_nominal_arm(shared_data):
    """Draws of 6 to 12 poses of a measured UR10, judged on 200 others; of 40 per robot, 38 are at most 1.05 times."""
    rows = Measurements.read_csv(shared_data / "ur10/series_c_train.csv")
    rng, calibrator, ratios = np.random.default_rng(1), GeometricCalibrator(Robot.load("ur10")), []
    for count in (6, 7, 7, 8, 9, 12):
        chosen = torch.from_numpy(rng.permutation(rows.rows))
        few, others = rows.select(chosen[:count]), rows.select(chosen[-200:])
        with no_type_checker():
            results = (fit_if_better(calibrator, few, nothing), base_and_tool_calibrator(calibrator).fit(few))
            fitted, nominal = (pose_errors_of(result, others).figures.rms_mm for result in results)
        ratios.append(fitted / nominal)
    assert max(ratios) <= 1.05
    assert np.median(ratios) < 0.9


@pytest.mark.parametrize("hybrid", [False, True])
def test_an_arm_without_errors_remains_nominal(hybrid):
    arm = simulate("ur10", rows=7, noise=1e-3, turn_noise=1e-3, length=1e-6, angle=1e-6)
    calibrator = GeometricCalibrator(arm.nominal)
    result = fit_if_better(HybridCalibrator(calibrator) if hybrid else calibrator, arm.measurements, nothing)
    robot = (result.geometric if hybrid else result).robot
    assert np.array_equal(robot.dh, arm.nominal.dh)


def test_ten_positions_of_an_arm_with_clear_errors_are_fitted():
    arm = simulate("ur10", rows=110, noise=5e-5, length=1e-3, angle=1e-3)
    rows = replace(arm.measurements, rotation=None)
    few, others = rows.select(torch.arange(10)), rows.select(torch.arange(10, 110))
    calibrator = GeometricCalibrator(arm.nominal)
    with no_type_checker():
        results = (fit_if_better(calibrator, few, nothing), base_and_tool_calibrator(calibrator).fit(few))
        fitted, nominal = (pose_errors_of(result, others).figures.rms_mm for result in results)
    assert fitted < 0.2 * nominal
