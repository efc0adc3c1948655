"""Simulated robots of one type: errors that all share, and parts of each."""

import torch
from torch import Tensor

from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

DRAWN = Robot.load("rb5")
NOISE = 3.5e-5
"""[m] Of a coordinate."""
SHARED, INDIVIDUAL = 1e-3, 2e-4
"""[m or rad] Standard deviations of the geometric errors that all robots share, and of those of each."""
GEARS = (2e-4, 1e-4, 0.0)
"""[rad] Standard deviations of the harmonics of gears."""


def common_errors(seed: int = 5) -> Tensor:
    """Errors of the geometry that all robots of a type share."""
    return (
        torch.randn(DRAWN.dh.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        * SHARED
    )


def common_gears() -> Tensor:
    """Weights of harmonics that all robots of a type share, of every joint."""
    sizes = torch.tensor(GEARS * 2, dtype=torch.float64)
    return (
        torch.randn(DRAWN.dof, len(sizes), generator=torch.Generator().manual_seed(7), dtype=torch.float64)
        * sizes
    )


def rows_of(
    number: int,
    rows: int,
    seed: int,
    odd: bool = False,
    noise: float = NOISE,
    individual: float = INDIVIDUAL,
    individual_gears: float = 1.0,
) -> Measurements:
    """Positions that a robot takes.

    Args:
        number: of the robot.
        rows: how many.
        seed: of joint values and noise.
        odd: whether its shared errors are those of another type.
        noise: of a coordinate [m].
        individual: standard deviation of the geometric errors of its own [m or rad].
        individual_gears: share of the variance of harmonics that differs from robot to robot.
    """
    of_robot = torch.Generator().manual_seed(1000 + number)
    errors = common_errors(6 if odd else 5)
    errors = errors + torch.randn(errors.shape, generator=of_robot, dtype=torch.float64) * individual
    series = FourierSeries(DRAWN, len(GEARS))
    sizes = torch.tensor(GEARS * 2, dtype=torch.float64)
    weights = torch.randn(DRAWN.dof, len(sizes), generator=of_robot, dtype=torch.float64) * sizes
    weights = individual_gears**0.5 * weights + (1 - individual_gears) ** 0.5 * common_gears()
    drawn = torch.Generator().manual_seed(seed)
    q = 4 * torch.rand(rows, DRAWN.dof, generator=drawn, dtype=torch.float64) - 2
    moved = q + (series.columns(JointState(q)) * weights).sum(-1)
    base, tool = DRAWN.base.copy(), DRAWN.tool.copy()
    base[:3], tool[:3] = (1.0, 0.5, 0.2), (0.05, 0.02, 0.15)
    robot = DRAWN.with_geometry(dh=DRAWN.dh + errors.numpy(), base=base, tool=tool)
    position = forward_kinematics(robot, moved)[:, :3, 3]
    return Measurements(
        q=q, position=position + noise * torch.randn(rows, 3, generator=drawn, dtype=torch.float64)
    )
