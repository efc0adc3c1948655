"""Calibrated arms for tests of kernels: random errors, and all corrections with a compiled form."""

import functools
import math
import sys

import numpy as np
import pytest
import torch
from testing.models import no_type_checker

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gear_lines import GearLines
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.shared_features import ScaledJoints, SinesCosines
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.robot import Robot

BASE, TOOL = np.array([0.1, -0.2, 0.3, 0.4, 0.1, -0.2]), np.array([0.02, 0.03, 0.1, 0.1, 0.2, 0.3])
ERRORS = np.array([1e-3, 5e-4, 5e-4, 1e-3, 1e-3])
"""Standard deviations of the errors of a row: theta, d, a, alpha, beta [rad, m]."""


def draw_joints(robot: Robot, rows: int, seed: int = 1, share: float = 1.0) -> torch.Tensor:
    """Draw joint values [rad or m] within a share of the limits, at most a turn."""
    limits = np.clip(robot.limits, -math.pi, math.pi) * share
    return torch.from_numpy(
        np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (rows, robot.dof))
    )


def draw_correction(robot: Robot, joints: bool, seed: int = 0) -> JointCorrection:
    """Draw a correction of about 1e-3 rad with all features and product units."""
    features = [
        FourierSeries(robot, 12),
        GravityTorques(robot, (0.1, -0.2, -1.0)),
        SinesCosines(robot),
        GearLines(robot, [(), (30, 202), *[()] * (robot.dof - 3), (101,)]),
    ]
    features += [ScaledJoints(robot)] if joints else []
    correction = JointCorrection(robot, features, (2, 3))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight, chosen in zip(correction.linear, features, strict=True):
            drawn = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
            weight.copy_(5e-4 / math.sqrt(chosen.column_count) * drawn * chosen.used)
        for weight in (correction.weight, correction.bias):
            weight.copy_(0.02 * torch.randn(weight.shape, generator=generator, dtype=torch.float64))
    return correction.requires_grad_(False)


@functools.cache
def calibrated(name: str, hybrid: bool = True, covered: float = 1.0, joints: bool = False) -> CalibratedModel:
    """Return a calibrated robot of the catalogue.

    Args:
        name: name of the robot.
        hybrid: whether it has a joint correction.
        covered: share of the joint range that was measured.
        joints: whether the correction has features that change from turn to turn.
    """
    rng = np.random.default_rng(0)
    robot = Robot.load(name).with_geometry(base=BASE, tool=TOOL)
    geometric = robot.with_geometry(dh=robot.dh + ERRORS * rng.normal(size=robot.dh.shape))
    arm = None
    if hybrid:
        other = geometric.with_geometry(dh=geometric.dh + 0.2 * ERRORS * rng.normal(size=robot.dh.shape))
        measured = JointCoverage.from_joints(robot, draw_joints(robot, 400, share=covered))
        arm = HybridArm(other, draw_correction(robot, joints), measured)
    starts = draw_joints(robot, 400, share=covered)
    return CalibratedModel(
        f"calibrated {name}", "test", robot, None, None, (), starts, calibrated=geometric, hybrid=arm
    )


@functools.cache
def compiled(name: str, hybrid: bool = True, covered: float = 1.0, joints: bool = False):
    """The compiled inverse kinematics of `calibrated`."""
    with no_type_checker():
        return CompiledIK.from_model(calibrated(name, hybrid, covered, joints))


@pytest.fixture(scope="session")
def arms():
    """The functions `calibrated`, `compiled` and `draw_joints` under one roof."""
    return sys.modules[__name__]
