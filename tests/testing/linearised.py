"""Linearised rows of simulated arms, for tests of the hybrid's parts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.noise import contributions_and_noise_of
from pisigma.calibration.geometric.problem.setup import CalibrationSetup
from pisigma.calibration.hybrid.design import Design, LinearisedRows
from pisigma.calibration.hybrid.regression import NormalEquations
from pisigma.calibration.hybrid.search import FeatureFit
from pisigma.calibration.hybrid.sensor_values import sensor_values
from pisigma.estimation.loss import SquaredLoss
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import held_out_groups
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, rotation_from_vector, transform_from_xyz_zyx

FRAMES = torch.tensor(
    [[0.3, -0.2, 0.1, 0.4, -0.2, 0.3], [0.5, -0.3, 0.2, 0.4, -0.2, 1.0]], dtype=torch.float64
)
TARGETS = torch.tensor(
    [[0.02, -0.03, 0.1, 0.2, 0.1, -0.2], [0.05, 0.1, -0.04, 0.3, -0.1, 0.2]], dtype=torch.float64
)
"""x, y, z [m], roll, pitch, yaw [rad] of two frames in the base and of two targets on the tool."""


def random_joints(robot: Robot, rows: int, seed: int, widest: float = np.pi) -> Tensor:
    """Draw joint values [rad or m], uniform over the limits, with a maximum angle of revolute joints."""
    most = np.where(robot.revolute, widest, np.inf)[:, None]
    low, high = np.clip(robot.limits, -most, most).T
    return torch.from_numpy(np.random.default_rng(seed).uniform(low, high, (rows, robot.dof)))


def tracker_data(
    true: Robot,
    q: Tensor,
    delta: Tensor | float = 0.0,
    noise: float = 0.0,
    turn_noise: float | None = None,
    several: bool = False,
    seed: int = 0,
) -> Measurements:
    """Measure a robot with joint errors `delta` by a tracker.

    Args:
        true: the true robot.
        q: commanded joint values.
        delta: joint errors.
        noise: standard deviation of a coordinate [m].
        turn_noise: standard deviation of an angle [rad]; None for positions only.
        several: alternate two frames and two targets, instead of using one.
        seed: random seed of the noise.
    """
    rng = np.random.default_rng(seed)
    number = torch.arange(len(q)) * int(several)
    T = invert(transform_from_xyz_zyx(FRAMES))[number % 2] @ forward_kinematics(true, q + delta)
    T = T @ transform_from_xyz_zyx(TARGETS)[number // 2 % 2]
    position = T[:, :3, 3] + noise * torch.from_numpy(rng.normal(size=(len(q), 3)))
    rotation = None
    if turn_noise is not None:
        turn = rotation_from_vector(turn_noise * torch.from_numpy(rng.normal(size=(len(q), 3))))
        rotation = turn @ T[:, :3, :3]
    return Measurements(
        q=q,
        position=position,
        rotation=rotation,
        frame=tuple(("wall", "floor")[k] for k in (number % 2).tolist()),
        target=tuple(("A", "B")[k] for k in (number // 2 % 2).tolist()),
    )


@dataclass(frozen=True, eq=False)
class LinearisedArm:
    """The rows of a geometric calibration, linearised at its solution."""

    setup: CalibrationSetup
    rows: LinearisedRows
    noise: tuple[float, ...]
    prior_scale: tuple[float, ...]

    def fitted(self, features: Sequence[AbstractFeature], iterations: int = 40) -> FeatureFit:
        """Fit geometry and a unit of order 1, with prior scales and noise by the evidence."""
        design = Design(self.rows.problem, tuple(features))
        sums = NormalEquations.from_rows(design, self.rows)
        return FeatureFit(
            design, sums.maximise_evidence(design.prior(self.prior_scale), self.noise, iterations)
        )


def linearised(robot: Robot, measurements: Measurements, **options: object) -> LinearisedArm:
    """Calibrate the geometry by unweighted least squares, and linearise at the solution."""
    solved = GeometricCalibrator(robot, loss=SquaredLoss(), **options).solve(measurements)  # type: ignore[arg-type]
    here, problem = solved.solution.linearisation, solved.problem
    view = contributions_and_noise_of(here)
    values, design = sensor_values(problem, here.point), Design(problem, ())
    weights = [torch.ones_like(sensor.weight_root) for sensor in values]
    x, group = (here.point - problem.prior_mean)[problem.active], held_out_groups(solved.setup.measurements)
    rows = LinearisedRows.from_linearisation(design, x, values, weights, group)
    return LinearisedArm(solved.setup, rows, tuple(view.noise.tolist()), tuple(view.prior_scale.tolist()))


def with_directions(robot: Robot, directions: Sequence[int]) -> Robot:
    """Return the robot with reversed joints where the direction is -1."""
    rows = list(robot.rows)
    for place, direction in zip(robot.joint_rows, directions, strict=True):
        row = rows[place]
        low, high = sorted((direction * row.lower, direction * row.upper))
        rows[place] = replace(row, direction=direction, lower=low, upper=high)
    return replace(robot, rows=tuple(rows))
