"""The joint values of the catalogue's Panda are those of the maker."""

import math

import numpy as np
import torch
from testing.closeness import assert_close

from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

# The maker's modified DH parameters (Craig): a, d [m], alpha [deg] of the frame before every joint; then the flange.
MAKER = [
    (0, 0.333, 0),
    (0, 0, -90),
    (0, 0.316, 90),
    (0.0825, 0, 90),
    (-0.0825, 0.384, -90),
    (0, 0, 90),
    (0.088, 0, 90),
]
FLANGE = 0.107


def flange_by_the_maker(q: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    for angle, (a, d, twist) in zip(q, MAKER, strict=True):
        ca, sa = math.cos(math.radians(twist)), math.sin(math.radians(twist))
        c, s = math.cos(angle), math.sin(angle)
        T = T @ np.array(
            [[c, -s, 0, a], [s * ca, c * ca, -sa, -d * sa], [s * sa, c * sa, ca, d * ca], [0, 0, 0, 1]]
        )
    T[:3, 3] += FLANGE * T[:3, 2]
    return T


def test_the_flange_pose_is_that_of_the_maker():
    robot = Robot.load("panda")
    low, high = robot.limits.T
    for q in np.random.default_rng(0).uniform(low, high, (20, 7)):
        assert_close(forward_kinematics(robot, torch.from_numpy(q)), flange_by_the_maker(q), atol=1e-14)
