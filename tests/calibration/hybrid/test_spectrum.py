"""Lines in the spectrum of joint errors: which orders are found, and where there are none."""

import math

import numpy as np
import pytest
import torch
from testing.linearised import LinearisedArm, linearised, random_joints, tracker_data

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.spectrum import HIGHEST_ORDER, find_spectral_lines
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.robot import Robot

ROBOT = Robot.load("ur10")
ORDERS = ((), (256, 2020), (1010,), (405,), (406,), ())
"""Those of the measured UR10: gears of 1:101 and motors of 10 pairs of poles."""
SIZE = 8e-5


def rippled(q: torch.Tensor) -> torch.Tensor:
    """Errors of the joints [rad] that move the tool: all of `ORDERS` at SIZE, the wrist's larger."""
    delta = torch.zeros_like(q)
    for j, of_joint in enumerate(ORDERS):
        for order in of_joint:
            delta[:, j] += SIZE * (1 if j < 3 else 3) * (order * q[:, j] + j).sin()
    return delta


def lines_of(arm: LinearisedArm, lowest: int = 60) -> tuple[tuple[int, ...], ...]:
    fitted = arm.fitted([FourierSeries(arm.rows.problem.space.robot, 3)])
    return find_spectral_lines(fitted.design, arm.rows, fitted.posterior, lowest)


def arm_of(q: torch.Tensor, delta: torch.Tensor | float) -> LinearisedArm:
    return linearised(ROBOT, tracker_data(ROBOT, q, delta, 3e-5, 1e-4))


def test_lines_of_every_joint_are_found_and_nothing_else() -> None:
    q = random_joints(ROBOT, 400, 0)
    found = lines_of(arm_of(q, rippled(q)))
    assert tuple(tuple(sorted(of_joint)) for of_joint in found) == ORDERS


def test_noise_has_no_lines() -> None:
    q = random_joints(ROBOT, 200, 1)
    assert not any(
        lines_of(arm_of(q, 3e-5 * torch.from_numpy(np.random.default_rng(0).normal(size=q.shape))))
    )


@pytest.mark.parametrize("seed", [2, 4])
def test_a_calibration_keeps_no_orders_that_stand_out_of_noise_by_chance(seed: int) -> None:
    q = random_joints(ROBOT, 300, seed)
    delta = 3e-5 * torch.from_numpy(np.random.default_rng(seed).normal(size=q.shape))
    delta[:, 1] += 1e-4 * (2 * q[:, 1]).sin()
    calibrator = HybridCalibrator(ROBOT, ("lines", "series"), harmonics=(3,), products=False)
    result = calibrator.fit(tracker_data(ROBOT, q, delta, 3e-5, 1e-4))
    assert "series 3 + lines" in [trial.name for trial in result.trials]
    assert "lines" not in result.verdict


def test_lines_below_the_first_order_are_left_to_the_series() -> None:
    q = random_joints(ROBOT, 400, 0)
    assert lines_of(arm_of(q, rippled(q)), 2_021) == ((),) * 6
    assert lines_of(arm_of(q, rippled(q)), HIGHEST_ORDER + 1) == ((),) * 6


@pytest.mark.parametrize("grid", [360, 1_000])
def test_joint_values_on_a_grid_do_not_determine_orders_above_half_of_it(grid: int) -> None:
    """There order k and `grid - k` are the same at all values; the slower of the two is right."""
    step = 2 * math.pi / grid
    q = (random_joints(ROBOT, 300, 2) / step).round() * step
    delta = torch.zeros_like(q)
    delta[:, 1] = 2e-4 * ((grid - 100) * q[:, 1]).sin()
    assert lines_of(arm_of(q, delta)) == ((), (100,), (), (), (), ())


def test_a_joint_that_hardly_moves_has_no_lines() -> None:
    q = random_joints(ROBOT, 300, 3)
    q[:, 1] *= 1e-3
    delta = torch.zeros_like(q)
    delta[:, 1] = 2e-4 * (2_020 * q[:, 1]).sin()
    assert lines_of(arm_of(q, delta))[1] == ()


def test_a_calibration_keeps_lines_that_predict_held_out_rows() -> None:
    q = random_joints(ROBOT, 360, 4)
    train, test = torch.arange(300), torch.arange(300, 360)
    data = tracker_data(ROBOT, q, 2 * rippled(q), 3e-5, 1e-4)
    errors = {}
    for names in (("series",), ("lines", "series")):
        calibrator = HybridCalibrator(ROBOT, names, harmonics=(8,), products=False)
        result = calibrator.fit(data.select(train))
        errors[names] = float(result.errors_of(data.select(test))["position"].square().mean().sqrt())
    assert "lines" in result.verdict
    assert errors["lines", "series"] < 0.5 * errors["series",]
