"""Measured orientations help positions, and what the geometry cannot explain in them does not pull positions."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.simulated_arm import BASE, TOOL, dh_errors

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem import problem as calibration_problem
from pisigma.calibration.geometric.problem.noise import (
    ContributionsAndNoise,
    angle_variance_factor,
    contributions_and_noise_of,
)
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector

ROWS, SEEDS = 200, 5


def wrist_wobble(q: torch.Tensor, size: float, rng: np.random.Generator) -> torch.Tensor:
    """Turns [rad] of the tool that go with the wrist's joint values and leave the measured point where it is."""
    turn = torch.zeros(len(q), 3, dtype=torch.float64)
    for joint in (-1, -2, -3):
        for order in (1, 2):
            waves = torch.stack([torch.cos(order * q[:, joint]), torch.sin(order * q[:, joint])], 1)
            turn += waves @ torch.from_numpy(rng.normal(0.0, size / math.sqrt(6), (2, 3)))
    return turn


def position_errors(seed: int, wobble: float) -> tuple[float, float, CalibrationResult]:
    """RMS of new positions [m] after a fit of positions and after one of poses, and the latter."""
    rng = np.random.default_rng(seed)
    nominal = Robot.load("rb5")
    true = nominal.with_geometry(dh=nominal.dh + dh_errors(nominal, 3e-4, 4e-4, rng), base=BASE, tool=TOOL)

    def measure(rows: int, share: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        q = torch.from_numpy(share * rng.uniform(-2.5, 2.5, (rows, nominal.dof)))
        gears = 2e-5 * torch.sin(2 * q + torch.arange(nominal.dof))
        T = forward_kinematics(true, q + gears)
        turns = wrist_wobble(q, wobble, np.random.default_rng(100 + seed))
        return q, T[:, :3, 3], T[:, :3, :3] @ rotation_from_vector(turns)

    q, position, rotation = measure(ROWS, 0.5)
    position = position + 3e-5 * torch.from_numpy(rng.normal(size=position.shape))
    rotation = rotation_from_vector(5e-5 * torch.from_numpy(rng.normal(size=position.shape))) @ rotation
    new_q, new_position, _ = measure(500, 1.0)
    errors, result = [], None
    for rows in (Measurements(q, position), Measurements(q, position, rotation)):
        result = GeometricCalibrator(nominal).fit(rows)
        T = predicted_poses(result.robot, result.bases, result.tools, Measurements(new_q))
        errors.append(float((T[:, :3, 3] - new_position).square().sum(1).mean().sqrt()))
    assert result is not None
    return errors[0], errors[1], result


def factor_of(result: CalibrationResult) -> float:
    """By how much the variance of the orientations was enlarged."""
    return contributions_and_noise_of(result.solved.solution.linearisation).angle_variance_factor[1]


def ratio(wobble: float) -> tuple[float, list[float]]:
    """Error after a fit of poses over that after a fit of positions, geometric mean; and all factors."""
    cases = [position_errors(seed, wobble) for seed in range(SEEDS)]
    mean = math.exp(sum(math.log(poses / positions) for positions, poses, _ in cases) / SEEDS)
    return mean, [factor_of(result) for _, _, result in cases]


def test_unexplained_orientation_does_not_pull_positions(monkeypatch: pytest.MonkeyPatch) -> None:
    bounded, factors = ratio(wobble=5e-4)
    assert bounded < 1.03
    assert min(factors) > 3
    monkeypatch.setattr(
        calibration_problem, "angle_variance_factor", lambda _, view, *__: torch.ones_like(view.noise)
    )
    unbounded, _ = ratio(wobble=5e-4)
    assert unbounded > 1.2  # rows taken as independent


def test_orientation_that_the_geometry_explains_helps_positions() -> None:
    bounded, factors = ratio(wobble=0.0)
    assert bounded < 0.9
    assert sorted(factors)[SEEDS // 2] < 1.5


def test_the_factor_makes_lengths_move_by_as_much_as_expected() -> None:
    """Against the definition, with inverses written out."""
    result = position_errors(0, 5e-4)[2]
    problem, here = result.solved.problem, result.solved.solution.linearisation
    view = contributions_and_noise_of(here)
    held = view.scaled_precision(problem.precision[problem.active], problem.prior_group)
    off = (here.point - problem.prior_mean)[problem.active]
    factor = angle_variance_factor(problem.sensors, view, held, -held * off)[1]
    usual = torch.diag(problem.step_scale)
    (Q, R), (lengths, angles) = (
        [getattr(part, name) / view.noise[k] ** 2 for k, part in enumerate(view.contributions)]
        for name in ("normal", "descent")
    )
    A, a = Q + torch.diag(held), lengths - held * off
    B, b = A + R / factor, a + angles / factor
    inverses = [
        usual @ torch.linalg.pinv(usual @ M @ usual, rtol=1e-13, hermitian=True) @ usual for M in (A, B)
    ]  # lengths do not see how the tool is turned
    moved = inverses[0] @ a - inverses[1] @ b
    assert_close(moved @ Q @ moved, (Q * (inverses[0] - inverses[1])).sum(), rtol=5e-3)


def test_angles_alone_and_lengths_alone_keep_their_variance() -> None:
    rng = np.random.default_rng(0)
    robot = Robot.load("rb5")
    q = torch.from_numpy(rng.uniform(-1, 1, (30, 6)))
    T = forward_kinematics(robot, q)
    for rows in (Measurements(q, T[:, :3, 3]), Measurements(q, rotation=T[:, :3, :3])):
        solved = GeometricCalibrator(robot).solve(rows)
        view: ContributionsAndNoise = contributions_and_noise_of(solved.solution.linearisation)
        assert view.angle_variance_factor.tolist() == [1.0]
