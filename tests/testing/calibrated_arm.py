"""Calibrated arms with random errors and a random joint correction, made without measurements."""

import functools
import math

import numpy as np
import torch

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.registry import FEATURES
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot import Robot

BASE, TOOL = np.array([0.1, -0.2, 0.3, 0.4, 0.1, -0.2]), np.array([0.02, 0.03, 0.1, 0.1, 0.2, 0.3])
ERRORS = np.array([1e-3, 5e-4, 5e-4, 1e-3, 1e-3])
"""Standard deviations of the errors of a row: theta, d, a, alpha, beta [rad, m]."""


def joints_of(robot: Robot, rows: int, seed: int = 1, share: float = 1.0) -> torch.Tensor:
    """Draw joint values [rad or m] over a fraction of the limits, at most one turn."""
    limits = np.clip(robot.limits, -math.pi, math.pi) * share
    return torch.from_numpy(
        np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (rows, robot.dof))
    )


def random_correction(
    robot: Robot, shared: tuple[str, ...] = ("sin_cos",), harmonics: int = 12, size: float = 1.0
) -> JointCorrection:
    """Return a correction of about `size` times 1e-3 rad with all kinds of features, and product units."""
    features = [FourierSeries(robot, harmonics), GravityTorques(robot, (0.1, -0.2, -1.0))]
    features += [FEATURES[name](robot) for name in shared]
    correction = JointCorrection(robot, features, (2, 3))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight, chosen in zip(correction.linear, features, strict=True):
            drawn = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
            weight.copy_(size * 5e-4 / math.sqrt(chosen.column_count) * drawn * chosen.used)
        for weight in (correction.weight, correction.bias):
            weight.copy_(0.02 * size * torch.randn(weight.shape, generator=generator, dtype=torch.float64))
    return correction.requires_grad_(False)


@functools.cache
def calibrated_arm(
    name: str,
    hybrid: bool = True,
    covered: float = 1.0,
    shared: tuple[str, ...] = ("sin_cos",),
    size: float = 1.0,
) -> CalibratedModel:
    """Return a calibrated robot of the catalogue.

    Args:
        name: name of the robot.
        hybrid: whether it has a joint correction.
        covered: fraction of the joint range that was measured.
        shared: features in addition to the series and gravity.
        size: size of the correction [1e-3 rad].
    """
    return calibrated_robot(Robot.load(name), hybrid, covered, shared, size)


def calibrated_robot(
    robot: Robot,
    hybrid: bool = True,
    covered: float = 1.0,
    shared: tuple[str, ...] = ("sin_cos",),
    size: float = 1.0,
) -> CalibratedModel:
    """Return a calibrated robot of any description."""
    rng = np.random.default_rng(0)
    robot = robot.with_geometry(base=BASE, tool=TOOL)
    geometric = robot.with_geometry(dh=robot.dh + ERRORS * rng.normal(size=robot.dh.shape))
    arm, starts = None, joints_of(robot, 400, share=covered)
    if hybrid:
        other = geometric.with_geometry(dh=geometric.dh + 0.2 * ERRORS * rng.normal(size=robot.dh.shape))
        arm = HybridArm(
            other, random_correction(robot, shared, size=size), JointCoverage.from_joints(robot, starts)
        )
    return CalibratedModel(
        f"calibrated {robot.name}", "test", robot, None, None, (), starts, calibrated=geometric, hybrid=arm
    )
