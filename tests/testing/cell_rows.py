"""Rows of one UR10 with errors, as sessions of a cell measure them."""

import datetime

import numpy as np
import torch
from testing.simulated_arm import BASE, TOOL, dh_errors, draw_joints

from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

ROBOT = Robot.load("ur10")


def measured(
    rows: int, seed: int, zero: float = 0.0, base: np.ndarray = BASE, scale: float = 1.0
) -> Measurements:
    """Measure random poses.

    Args:
        rows: number of poses.
        seed: of joint values and noise.
        zero: by which the third joint has moved [deg].
        base: of the robot in the frame of the instrument.
        scale: factor of all coordinates.
    """
    dh = ROBOT.dh + dh_errors(ROBOT, 3e-4, 5e-4, np.random.default_rng(0))
    dh[2, 0] += np.deg2rad(zero)
    rng = np.random.default_rng([seed, 7])
    q = draw_joints(ROBOT, rows, rng)
    T = forward_kinematics(ROBOT.with_geometry(dh=dh, base=base, tool=TOOL), q)
    noise = 3e-5 * torch.from_numpy(rng.normal(size=(rows, 3)))
    return Measurements(q=q, position=scale * T[:, :3, 3] + noise)


def day(ago: int) -> str:
    """The day some days ago (ISO 8601)."""
    return (datetime.date.today() - datetime.timedelta(days=ago)).isoformat()
