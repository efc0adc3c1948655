"""Measurements that have nothing to do with the joint values are not to be trusted, whatever is fitted to them."""

import pytest
import torch
from testing.checked import checked, kinds_of
from testing.hybrid import few_robots

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector
from pisigma.validation.checks.unexplained import check_residual_size


@pytest.fixture(scope="module", autouse=True)
def few():
    """See `few_robots`; whether another robot was measured is tested in `test_measured_robots`."""
    with few_robots():
        yield


@pytest.mark.parametrize("size", [1.0, 5e-3])
@pytest.mark.parametrize("joint", [0, 4])
def test_positions_that_are_unrelated_to_the_only_joint_that_moves(generator, joint, size):
    q = torch.full((40, 6), 0.3, dtype=torch.float64)
    q[:, joint] = torch.linspace(-1.5, 1.5, 40)
    position = size * torch.rand(40, 3, generator=generator, dtype=torch.float64)
    kinds = kinds_of(GeometricCalibrator(Robot.load("ur5")), Measurements(q=q, position=position))
    assert ("residual", "implausible") in kinds


def test_orientations_are_evaluated_like_positions(generator):
    q = torch.rand(40, 6, generator=generator, dtype=torch.float64)
    robot = Robot.load("ur10")
    T = forward_kinematics(robot, q)
    wrong = rotation_from_vector(0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64))
    rows = Measurements(q=q, position=T[:, :3, 3], rotation=T[:, :3, :3])
    assert not list(check_residual_size(checked(GeometricCalibrator(robot), rows)))
    rows = Measurements(q=q, position=T[:, :3, 3], rotation=wrong @ T[:, :3, :3])
    (diagnostic,) = check_residual_size(checked(GeometricCalibrator(robot), rows))
    assert diagnostic.cause == "rotation"
    assert 0.01 < diagnostic.values["residual_rad"] < 0.1
