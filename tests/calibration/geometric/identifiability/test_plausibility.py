"""Data that cannot be of the robot are refused, not fitted."""

from dataclasses import replace

import pytest
import torch
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import ImplausibleError
from pisigma.robot import Robot

ROBOT = "ur10"


def refuses(measurements, **options):
    with pytest.raises(ImplausibleError):
        GeometricCalibrator(Robot.load(ROBOT), **options).fit(measurements)


def test_millimetres_for_metres():
    measurements = simulate(ROBOT, rows=80).measurements
    refuses(replace(measurements, position=1000 * measurements.position))


@pytest.mark.parametrize("options", [{}, {"prior_scaling": "widened"}])
def test_metres_for_millimetres(options):
    measurements = simulate(ROBOT, rows=80).measurements
    refuses(replace(measurements, position=measurements.position / 1000), **options)


def test_a_joint_that_counts_the_other_way():
    measurements = simulate(ROBOT, rows=80).measurements
    refuses(
        replace(measurements, q=measurements.q * torch.tensor([1.0, -1, 1, 1, 1, 1], dtype=torch.float64))
    )


def test_two_joints_swapped():
    measurements = simulate(ROBOT, rows=80).measurements
    refuses(replace(measurements, q=measurements.q[:, [0, 2, 1, 3, 4, 5]]), free="joint_offsets")


def test_base_and_tool_alone_are_fitted_however_far_the_arm_is_off():
    measurements = simulate(ROBOT, rows=80).measurements
    swapped = replace(measurements, q=measurements.q[:, [0, 2, 1, 3, 4, 5]])
    result = GeometricCalibrator(Robot.load(ROBOT), free=()).fit(swapped)
    assert result.noise[0].rms > 0.05
