"""A small plan for a robot with errors, and measurements of its poses by a tracker, for tests."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from testing.simulated_arm import BASE, TOOL, dh_errors
from torch import Tensor

from pisigma.measurement.dataset import Measurements
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.plan_inputs import find_candidates
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

CHECKS = 3
"""Number of poses that test the calibration."""
NOISE = 3e-5
"""Standard deviation of the tracker [m]."""


@dataclass(frozen=True, eq=False)
class MeasuredPlan:
    """A plan, and the robot that is measured with it.

    Attributes:
        stored: the plan.
        true: the true robot.
    """

    stored: StoredPlan
    true: Robot

    def measure(self, q: Float64[Tensor, "rows dof"], first_line: int = 2, seed: int = 5) -> Measurements:
        """Measure joint values [rad] by a tracker."""
        noise = np.random.default_rng(seed).normal(size=(len(q), 3)) * NOISE
        position = forward_kinematics(self.true, q)[:, :3, 3] + torch.from_numpy(noise)
        return Measurements(q=q, position=position, line=tuple(range(first_line, first_line + len(q))))

    def rows(self, count: int) -> Measurements:
        """Measure the first poses."""
        return self.measure(self.stored.q[:count])


def measured_plan(name: str = "ur5", poses: int = 24, seed: int = 0) -> MeasuredPlan:
    """Plan for a robot of the catalogue with errors of a usual size."""
    robot = Robot.load(name)
    true = robot.with_geometry(
        dh=robot.dh + dh_errors(robot, 3e-4, 6e-4, np.random.default_rng(seed)), base=BASE, tool=TOOL
    )
    settings = PlanSettings(count=poses - CHECKS, check=CHECKS, candidates=120, sigma_mm=NOISE * 1e3)
    arm = ArmInSurroundings.from_robot(robot)
    candidates = find_candidates(settings, arm)
    check = torch.arange(poses) % (poses // CHECKS) == 4
    return MeasuredPlan(
        StoredPlan(
            arm,
            settings,
            None,
            candidates.q[:poses],
            check,
            candidates.number[:poses],
            (candidates.q[:0],) * poses,
        ),
        true,
    )


def with_offset(rows: Measurements, row: int, offset: tuple[float, float, float]) -> Measurements:
    """Return the rows with an offset [m] of one position."""
    assert rows.position is not None
    position = rows.position.clone()
    position[row] += torch.tensor(offset, dtype=torch.float64)
    return Measurements(q=rows.q, position=position, line=rows.line)


def header(robot: Robot) -> str:
    """Return the header of the rows that `row_lines` writes."""
    joints = (f"q{number}_{joint.file_unit}" for number, joint in enumerate(robot.joints, start=1))
    return ",".join([*joints, "x_mm,y_mm,z_mm\n"])


def row_lines(robot: Robot, rows: Measurements) -> list[str]:
    """Return the rows as lines of a measurement file."""
    assert rows.position is not None
    lines = []
    for q, position in zip(rows.q.tolist(), (rows.position * 1e3).tolist(), strict=True):
        joints = [joint.in_file_unit(value) for joint, value in zip(robot.joints, q, strict=True)]
        lines.append(",".join(f"{value:.7f}" for value in (*joints, *position)) + "\n")
    return lines
