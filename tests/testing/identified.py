"""Hand-made models with an identified geometry, and with a joint correction."""

import numpy as np
import torch
from testing.models import hand_made_model, joints_around

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot import Robot

ROWS, SPREAD = 60, 0.5
"""Number of joint values that count as measured, and half their range [rad]."""


def off_by(robot: Robot, length: float = 3e-4, angle: float = 2e-3, seed: int = 0) -> Robot:
    """Return the robot with errors of about `size` in all lengths [m] and angles [rad] of its rows.

    Axes of an arm of fewer than six joints stay parallel, or it could not take the poses of the nominal one.
    """
    off = np.random.default_rng(seed).normal(size=robot.dh.shape)
    off[:, 3:] *= robot.dof >= 6
    return robot.with_geometry(robot.dh + off * [angle, length, length, angle, angle])


def geometric_model(name: str, robot: Robot | None = None) -> CalibratedModel:
    """Return a model of a robot of `testing.models.HOMES` with geometric errors."""
    robot = robot or Robot.load(name)
    return CalibratedModel(
        name=f"geometric_{name}",
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=hand_made_model(name).branches,
        starts=joints_around(name, ROWS, spread=SPREAD),
        calibrated=off_by(robot),
        bases={"": robot.base.copy()},
        tools={"": robot.tool.copy()},
    )


def hybrid_model(
    name: str,
    features: list[AbstractFeature],
    *,
    orders: tuple[int, ...] = (),
    size: float = 1e-3,
    robot: Robot | None = None,
) -> CalibratedModel:
    """Return such a model with a joint correction of random weights [rad or m] over the columns of a joint."""
    model = geometric_model(name, robot)
    correction = JointCorrection(model.robot, features, orders)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for chosen, weight in zip(correction.features, correction.linear, strict=True):
            drawn = torch.randn(weight.shape, generator=generator, dtype=torch.float64)
            weight.copy_(size / chosen.column_count**0.5 * drawn * chosen.used)
        for part in (correction.weight, correction.bias):
            part.copy_(size**0.5 * torch.randn(part.shape, generator=generator, dtype=torch.float64))
    correction.requires_grad_(False)
    assert model.calibrated is not None
    arm = HybridArm(
        off_by(model.calibrated, 1e-5, 1e-5, seed=1),
        correction,
        JointCoverage.from_joints(model.robot, model.starts),
    )
    return CalibratedModel(
        **{
            **vars(model),
            "name": f"hybrid_{name}",
            "kind": "hybrid_calibration",
            "hybrid": arm,
            "hybrid_bases": model.bases,
            "hybrid_tools": model.tools,
        }
    )
