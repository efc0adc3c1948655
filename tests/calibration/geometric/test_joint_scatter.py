"""The scatter of joints is estimated from images, separately from errors that all corners of an image share."""

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.phone_arm import arm_before_phone, rows_of_phone

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.joint_repeatability import corner_sigma_factor
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.robot import Robot


def estimated_scatter(rows):
    """Return the estimated standard deviation of joint values [rad]."""
    result = GeometricCalibrator(Robot.load("so101")).fit(rows)
    (noise,) = (one.sigma for one in result.noise if one.sensor == "corner")
    return result.solved.setup.joint_repeatability * corner_sigma_factor(rows, noise)


@pytest.mark.parametrize(
    ("degrees", "shared"),
    [(1.0, Repeatability(0.0, 0.0)), (0.3, Repeatability(5e-4, np.deg2rad(0.15)))],
)
def test_scatter_is_estimated(degrees, shared):
    true, q, random = arm_before_phone(3)
    rows = rows_of_phone(true, q[:60], random, 3, np.deg2rad(degrees), shared)
    assert np.rad2deg(estimated_scatter(rows)) == pytest.approx(degrees, rel=0.2)


def test_few_images_keep_the_scatter_of_the_class():
    true, q, random = arm_before_phone(3)
    rows = rows_of_phone(true, q[:8], random, 3)
    solved = GeometricCalibrator(Robot.load("so101")).solve(rows)
    assert (
        solved.setup.joint_repeatability
        == GeometricCalibrator(Robot.load("so101")).class_of_robot.joint_repeatability
    )


def test_images_of_other_classes_are_weighted_by_their_corners():
    true, q, random = arm_before_phone(3)
    rows = rows_of_phone(true, q[:30], random, 3, 1e-4)
    setup = GeometricCalibrator(Robot.load("so101"), robot_class="industrial").build(rows)
    (corners,) = (one for one in setup.problem.sensors if one.name == "corner")
    assert_close(corners.weight, setup.corner_sensor(setup.measurements).weight)
