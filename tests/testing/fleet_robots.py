"""Simulated robots of one type, with shared and individual errors."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from pisigma.estimation import population
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.lifetime.fleet import prior
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

NOMINAL = Robot.load("rb5")
NOISE = 3.5e-5
"""Standard deviation of a coordinate [m]."""
SHARED, INDIVIDUAL = 1e-3, 2e-4
"""Standard deviations of the shared and of the individual geometric errors [m or rad]."""
GEARS = (2e-4, 1e-4, 0.0)
"""Standard deviations of the harmonics of gears [rad]."""


@contextmanager
def few_steps() -> Iterator[None]:
    """Estimate fleet priors with a twentieth of the steps, for tests of other subjects."""
    whole = population.expectation_maximisation

    def with_few(evidence, start, class_variances, class_weight_in_robots=population._CLASS_ROBOTS, steps=0):
        return whole(evidence, start, class_variances, class_weight_in_robots, steps=3)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prior, "LINEARISATIONS", 1)
        patch.setattr(population, "expectation_maximisation", with_few)
        yield


def common_errors(seed: int = 5) -> Tensor:
    """Return the geometric errors that all robots of a type share."""
    return (
        torch.randn(NOMINAL.dh.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        * SHARED
    )


def common_gears() -> Tensor:
    """Return the weights of harmonics of every joint that all robots of a type share."""
    sizes = torch.tensor(GEARS * 2, dtype=torch.float64)
    return (
        torch.randn(NOMINAL.dof, len(sizes), generator=torch.Generator().manual_seed(7), dtype=torch.float64)
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
    """Measure positions of a robot.

    Args:
        number: number of the robot.
        rows: number of rows.
        seed: random seed of joint values and noise.
        odd: whether it has the shared errors of another type.
        noise: standard deviation of a coordinate [m].
        individual: standard deviation of its individual geometric errors [m or rad].
        individual_gears: fraction of the variance of harmonics that differs between robots.
    """
    of_robot = torch.Generator().manual_seed(1000 + number)
    errors = common_errors(6 if odd else 5)
    errors = errors + torch.randn(errors.shape, generator=of_robot, dtype=torch.float64) * individual
    series = FourierSeries(NOMINAL, len(GEARS))
    sizes = torch.tensor(GEARS * 2, dtype=torch.float64)
    weights = torch.randn(NOMINAL.dof, len(sizes), generator=of_robot, dtype=torch.float64) * sizes
    weights = individual_gears**0.5 * weights + (1 - individual_gears) ** 0.5 * common_gears()
    generator = torch.Generator().manual_seed(seed)
    q = 4 * torch.rand(rows, NOMINAL.dof, generator=generator, dtype=torch.float64) - 2
    moved = q + (series.columns(JointState(q)) * weights).sum(-1)
    base, tool = NOMINAL.base.copy(), NOMINAL.tool.copy()
    base[:3], tool[:3] = (1.0, 0.5, 0.2), (0.05, 0.02, 0.15)
    robot = NOMINAL.with_geometry(dh=NOMINAL.dh + errors.numpy(), base=base, tool=tool)
    position = forward_kinematics(robot, moved)[:, :3, 3]
    return Measurements(
        q=q, position=position + noise * torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    )
