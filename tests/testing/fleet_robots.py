"""Simulated robots of one type: errors that all share, and parts of each."""

import torch
from torch import Tensor

from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.conditions import JointState
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

DRAWN = Robot.load("rb5")
NOISE = 3.5e-5
"""[m] Of a coordinate."""
SHARED, OWN = 1e-3, 2e-4
"""[m or rad] Standard deviations of what all robots share, and of the parts of each."""
GEARS = (2e-4, 1e-4, 0.0)
"""[rad] Standard deviations of the harmonics, whose phases differ from robot to robot."""


def common_errors(seed: int = 5) -> Tensor:
    """Errors of the geometry that all robots of a type share."""
    return (
        torch.randn(DRAWN.dh.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        * SHARED
    )


def rows_of(number: int, rows: int, seed: int, odd: bool = False, noise: float = NOISE) -> Measurements:
    """Positions that a robot takes.

    Args:
        number: of the robot.
        rows: how many.
        seed: of joint values and noise.
        odd: whether its shared errors are those of another type.
        noise: of a coordinate [m].
    """
    own = torch.Generator().manual_seed(1000 + number)
    errors = common_errors(6 if odd else 5)
    errors = errors + torch.randn(errors.shape, generator=own, dtype=torch.float64) * OWN
    series = FourierSeries(DRAWN, len(GEARS))
    sizes = torch.tensor(GEARS * 2, dtype=torch.float64)
    weights = torch.randn(DRAWN.dof, len(sizes), generator=own, dtype=torch.float64) * sizes
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
