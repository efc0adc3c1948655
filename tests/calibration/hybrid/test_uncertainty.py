"""Standard deviations of predicted positions against X C X^T, finite differences and new simulated poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.dense_regression import DenseRegression
from testing.linearised import LinearisedArm, linearised, random_joints, tracker_data, with_directions
from testing.posteriors import covariance as covariance_of
from torch import Tensor

from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.calibration.geometric.problem.setup import identified_geometry
from pisigma.calibration.hybrid.regression import NormalEquations
from pisigma.calibration.hybrid.search import FeatureFit
from pisigma.calibration.hybrid.uncertainty import PositionUncertainty, position_uncertainty
from pisigma.estimation.held_out import MAX_SCALE, HeldOutErrors, held_out_covariance_factor
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import MIN_EFFECTIVE, prior_scale_columns
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot import Robot


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def small_problem() -> tuple[DenseRegression, GaussianPrior]:
    group = torch.tensor([0] * 4 + [1] * 6 + [2] * 3)
    X = normal(60, 13, seed=3)
    X[:, 10:] *= 1e-4  # a group of which hardly anything is told
    truth = normal(13, seed=4) * torch.tensor([1.0, 0.3, 0.5], dtype=torch.float64)[group]
    y = X @ truth + 0.4 * normal(60, seed=5)
    sizes = torch.tensor([1.0, 0.3, 0.5], dtype=torch.float64)
    return DenseRegression.between([X], [y]), GaussianPrior(
        torch.ones(13, dtype=torch.float64), group, sizes, 0
    )


def test_uncertain_sizes_add_what_the_unknowns_move_with_them() -> None:
    fit, prior = small_problem()
    posterior = fit.solve(prior, (0.4,))
    covariance = covariance_of(fit, posterior)
    expected, step = torch.zeros(13, 13, dtype=torch.float64), 1e-4
    told_at_all = []
    for g in range(3):
        ends = []
        for sign in (1, -1):
            sizes = prior.group_scales.clone()
            sizes[g] *= math.exp(sign * step)
            ends.append(fit.solve(replace(prior, group_scales=sizes), (0.4,)).x)
        slope = (ends[0] - ends[1]) / (2 * step)
        told = float((1 - prior.precision * covariance.diagonal())[prior.group == g].sum())
        told_at_all.append(told > MIN_EFFECTIVE)
        if told > MIN_EFFECTIVE:
            expected += slope[:, None] * slope / (2 * told)
    assert told_at_all == [True, True, False]
    added = prior_scale_columns(posterior, fit.covariance_root(posterior))
    assert_close(added @ added.t(), expected, atol=1e-7 * float(expected.abs().max()))


def test_sizes_of_unknowns_without_a_prior_add_nothing() -> None:
    fit, prior = small_problem()
    flat = replace(prior, unit_precision=torch.where(prior.group == 2, prior.unit_precision, 0.0))
    posterior = fit.solve(flat, (0.4,))
    added = prior_scale_columns(posterior, fit.covariance_root(posterior))
    assert_close(added, torch.zeros_like(added))


def missed(error: Tensor, spread: Tensor) -> HeldOutErrors:
    zeros = torch.zeros(len(error), dtype=torch.int64)
    return HeldOutErrors(error, spread, zeros)


def test_widening_makes_held_out_errors_as_large_as_predicted() -> None:
    spread = 1 + normal(500, seed=0).abs()
    error = 3 * spread * normal(500, seed=1)
    factor = held_out_covariance_factor(missed(error, spread))
    assert factor > 2
    assert_close((error.square() / (1 + factor * (spread.square() - 1))).mean(), 1.0, atol=1e-9)


def test_errors_as_predicted_do_not_widen_intervals_and_widening_is_limited() -> None:
    spread = 1 + normal(500, seed=0).abs()
    assert held_out_covariance_factor(missed(0.9 * normal(500, seed=1), spread)) == 1.0
    hopeless = held_out_covariance_factor(missed(100 + spread, torch.ones_like(spread)))
    assert_close(hopeless, MAX_SCALE, rtol=1e-9)


@pytest.fixture(scope="module")
def arm() -> LinearisedArm:
    """Poses of a robot with a sliding joint and one that counts backwards, in two frames with two targets."""
    robot = with_directions(Robot.load("kiro3"), (1, -1, -1, 1))
    q = random_joints(robot, 120, 0)
    return linearised(robot, tracker_data(robot, q, 2e-4 * torch.sin(q), 3e-5, 1e-4, several=True))


def uncertainty(arm: LinearisedArm) -> tuple[PositionUncertainty, FeatureFit, JointCorrection]:
    robot = arm.rows.problem.space.robot
    fitted = arm.fitted((GravityTorques(robot), FourierSeries(robot, 1)), 5)
    problem = arm.rows.problem
    point = problem.prior_mean.index_add(0, problem.active, fitted.posterior.x[: fitted.design.active_count])
    known = identified_geometry(arm.setup, point)
    found = position_uncertainty(
        arm.rows, fitted.design, NormalEquations.from_rows(fitted.design, arm.rows), fitted.posterior, known
    )
    correction = JointCorrection(robot, fitted.design.features).requires_grad_(False)
    for k, chosen in enumerate(fitted.design.features):
        correction.linear[k][chosen.used] = fitted.posterior.x[fitted.design.weights_of(k)]
    return found, fitted, correction


def test_deviation_is_that_of_the_derivative_by_all_unknowns(arm: LinearisedArm) -> None:
    """Taken by finite differences of the prediction, by every parameter and every weight."""
    found, _, correction = uncertainty(arm)
    robot, known = found.geometry.robot, found.geometry
    test = tracker_data(robot, random_joints(robot, 8, 1), several=True)
    space = found.space
    dh0 = robot.dh.flatten()
    frames = np.concatenate([*known.bases.values(), *known.tools.values()])
    parameters = np.concatenate([dh0, frames])
    weights = torch.cat([w[c.used] for w, c in zip(correction.linear, correction.features, strict=True)])

    def predicted(values: np.ndarray, own: Tensor) -> Tensor:
        start = 0
        for k, chosen in enumerate(correction.features):
            count = int(chosen.used.sum())
            correction.linear[k][chosen.used] = own[start : start + count]
            start += count
        arm_part, rest = (
            values[: space.arm_parameter_count],
            values[space.arm_parameter_count :].reshape(-1, 6),
        )
        moved = replace(test, q=test.q + correction(test.q))
        bases = dict(zip(known.bases, rest[:2], strict=True))
        tools = dict(zip(known.tools, rest[2:], strict=True))
        shaped = robot.with_geometry(dh=arm_part.reshape(robot.dh.shape))
        return predicted_poses(shaped, bases, tools, moved)[:, :3, 3]

    columns, step = [], 1e-5
    for k in range(len(parameters)):
        h = np.zeros_like(parameters)
        h[k] = step
        columns.append((predicted(parameters + h, weights) - predicted(parameters - h, weights)) / (2 * step))
    for k in range(len(weights)):
        change = torch.zeros_like(weights)
        change[k] = step
        columns.append(
            (predicted(parameters, weights + change) - predicted(parameters, weights - change)) / (2 * step)
        )
    predicted(parameters, weights)
    J = torch.stack(columns, -1)
    expected = (J @ found.dense_root).square().sum(-1).sqrt()
    got = found.sigma(test, correction)
    assert_close(got, expected, rtol=1e-5)
    assert float(got.min()) > 1e-6
    assert float(got.max()) < 1e-4


def test_deviation_is_that_of_drawn_calibrations(arm: LinearisedArm) -> None:
    """The covariance of positions at the training rows, as their columns give it, widened."""
    found, fitted, correction = uncertainty(arm)
    root = NormalEquations.from_rows(fitted.design, arm.rows).covariance_root(fitted.posterior)
    root = torch.cat([root.as_matrix, prior_scale_columns(fitted.posterior, root)], 1)
    C = root @ root.t()
    values = arm.rows.values[0].select(torch.arange(10))
    X = fitted.design.columns(values, slice(None))
    draws = torch.linalg.cholesky(C) @ normal(len(C), 4000, seed=8)
    drawn = (X @ draws).std(-1) * found.variance_factor**0.5
    of_rows = arm.setup.measurements.select(values.row)
    got = found.sigma(of_rows, correction)
    # Drawn along the axes of the problem, told along those of the frame: the length is the same.
    assert_close(got.norm(dim=1), drawn.norm(dim=1), rtol=0.05)


def test_more_rows_reduce_the_widening_which_is_at_least_one() -> None:
    robot = Robot.load("rb5")
    deviations = []
    for rows in (60, 240):
        own = linearised(robot, tracker_data(robot, random_joints(robot, rows, 2), noise=3e-5))
        found, _, correction = uncertainty(own)
        test = tracker_data(robot, random_joints(robot, 200, 3))
        deviations.append(float(found.sigma(test, correction).mean()))
        assert 1.0 <= found.variance_factor < 3.0
    assert 0.3 < deviations[1] / deviations[0] < 0.75


def test_sizes_and_noise_of_many_groups_are_those_of_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Robot.load("rb5")
    own = linearised(robot, tracker_data(robot, random_joints(robot, 80, 2), noise=3e-5))
    folds = uncertainty(own)[0].variance_factor
    monkeypatch.setattr("pisigma.calibration.hybrid.uncertainty.FEW_GROUPS", 10)
    single = uncertainty(own)[0].variance_factor
    assert 1.0 <= single < 1.5 * folds
    monkeypatch.setattr("pisigma.calibration.hybrid.uncertainty.CHUNK", 3)
    test = tracker_data(robot, random_joints(robot, 10, 3))
    found = uncertainty(own)[0]
    whole = found.sigma(test)
    for k in range(10):
        alone = found.sigma(test.select(torch.tensor([k])))
        assert_close(alone, whole[k : k + 1], rtol=1e-12)
