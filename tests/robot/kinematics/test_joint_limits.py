"""Wrapping of joint values."""

import math

import torch
from testing.closeness import assert_close

from pisigma.robot import Robot
from pisigma.robot.kinematics.joint_limits import wrapped_difference


def test_differences_are_wrapped_for_revolute_joints_only():
    robot = Robot.load("kiro3")
    q = torch.tensor([math.pi - 0.1, 0.5, 8.0, -3.0], dtype=torch.float64)
    nominal = torch.tensor([-math.pi + 0.1, 0.4, 1.0, 3.2], dtype=torch.float64)
    expected = torch.tensor([-0.2, 0.1, 7.0, 2 * math.pi - 6.2], dtype=torch.float64)
    assert_close(wrapped_difference(robot, q, nominal), expected, atol=1e-14)
    half = torch.tensor([math.pi, 0, 0, 0], dtype=torch.float64)
    assert_close(wrapped_difference(robot, half, torch.zeros(4, dtype=torch.float64))[0], math.pi, atol=0)
