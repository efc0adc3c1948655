"""Posterior, log evidence and prior scales against the direct formulas of a normal density."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from testing.closeness import assert_close
from testing.dense_regression import DenseRegression
from testing.posteriors import covariance as covariance_of
from testing.regression_cases import poses
from torch import Tensor

from pisigma.calibration.hybrid.regression import NormalEquations
from pisigma.estimation.prior import SMALLEST_SIZE, GaussianPrior

GROUP = torch.tensor([0, 0, 1, 1, 1, 2, 2, 2])
NOISE = (0.3, 0.8)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def problem(seed: int = 0, rows: int = 30) -> tuple[list[Tensor], list[Tensor]]:
    """Columns and targets of two sensors: three groups of unknowns of sizes 1, 2 and 0.3."""
    size = torch.tensor([1.0, 2.0, 0.3], dtype=torch.float64)[GROUP]
    truth = size * normal(8, seed=seed + 100)
    X = [normal(rows, 8, seed=seed + 200), normal(rows // 2, 8, seed=seed + 300)]
    y = [
        columns @ truth + sigma * normal(len(columns), seed=seed + 400 + k)
        for k, (columns, sigma) in enumerate(zip(X, NOISE, strict=True))
    ]
    return X, y


def prior(sizes: tuple[float, ...] = (0.7, 1.5, 0.4), classes: int = 0, **options: object) -> GaussianPrior:
    base = torch.linspace(0.5, 2.0, 8, dtype=torch.float64)
    return GaussianPrior(base, GROUP, torch.tensor(sizes, dtype=torch.float64), classes, **options)  # type: ignore[arg-type]


def marginal(X: list[Tensor], y: list[Tensor], precision: Tensor, noise: tuple[float, ...]) -> float:
    """Log of the density of all targets, the unknowns integrated out."""
    columns = torch.cat(X).numpy()
    variance = np.concatenate([np.full(len(t), sigma**2) for t, sigma in zip(y, noise, strict=True)])
    covariance = columns @ np.diag(1 / precision.numpy()) @ columns.T + np.diag(variance)
    return float(multivariate_normal(cov=covariance).logpdf(torch.cat(y).numpy()))


@pytest.mark.parametrize("seed", range(3))
def test_posterior_is_that_of_normal_variables(seed: int) -> None:
    X, y = problem(seed)
    fit = DenseRegression.between(X, y)
    found = fit.solve(prior(), NOISE)
    columns, targets = (
        np.concatenate([(part / sigma).numpy() for part, sigma in zip(parts, NOISE, strict=True)])
        for parts in (X, y)
    )
    covariance = np.linalg.inv(columns.T @ columns + np.diag(prior().precision.numpy()))
    assert_close(covariance_of(fit, found), covariance, atol=1e-12)
    assert_close(found.x, covariance @ columns.T @ targets, atol=1e-12)
    told = 1 - prior().precision.numpy() * covariance.diagonal()
    assert_close(found.effective_unknowns, told.sum(), rtol=1e-10)
    assert_close(found.determined_unknowns, np.bincount(GROUP, told), rtol=1e-10)
    assert_close(
        found.squared_unknowns,
        np.bincount(GROUP, prior().unit_precision.numpy() * found.x.numpy() ** 2),
        rtol=1e-12,
    )


@pytest.mark.parametrize("seed", range(3))
def test_log_evidence_is_the_marginal_density_up_to_a_constant_of_the_data(seed: int) -> None:
    X, y = problem(seed)
    constant = 0.5 * sum(map(len, y)) * math.log(2 * math.pi)
    for sizes, noise in (((0.7, 1.5, 0.4), NOISE), ((3.0, 0.1, 1e-3), (0.2, 2.0))):
        found = DenseRegression.between(X, y).solve(prior(sizes), noise).log_evidence
        assert_close(found, marginal(X, y, prior(sizes).precision, noise) + constant, atol=1e-7)


def test_unknowns_without_a_prior_add_a_constant_to_the_log_evidence() -> None:
    """It is the limit of a prior that gets ever wider, less what its width alone comes to."""
    X, y = problem()
    known, wide = prior(), 1e-6
    flat = replace(known, unit_precision=torch.where(GROUP == 0, 0.0, known.unit_precision))
    precision = torch.where(GROUP == 0, wide, known.precision)
    constant = 0.5 * sum(map(len, y)) * math.log(2 * math.pi) - 0.5 * 2 * math.log(wide)
    found = DenseRegression.between(X, y).solve(flat, NOISE).log_evidence
    assert_close(found, marginal(X, y, precision, NOISE) + constant, atol=1e-4)


@pytest.mark.parametrize("seed", range(2))
def test_log_evidence_is_stationary_in_sizes_and_noise(seed: int) -> None:
    X, y = problem(seed, rows=60)
    fit = DenseRegression.between(X, y)
    found = fit.maximise_evidence(prior(), NOISE, iterations=500, tolerance=0.0)

    def evidence(log_change: Tensor) -> float:
        sizes = found.prior.group_scales * log_change[:3].exp()
        noise = tuple(
            sigma * math.exp(change)
            for sigma, change in zip(found.noise, log_change[3:].tolist(), strict=True)
        )
        return fit.solve(replace(found.prior, group_scales=sizes), noise).log_evidence

    step = 1e-4
    slopes = []
    for k in range(5):
        change = torch.zeros(5, dtype=torch.float64)
        change[k] = step
        slopes.append((evidence(change) - evidence(-change)) / (2 * step))
    assert_close(np.array(slopes), 0.0, atol=1e-4)
    assert found.log_evidence > fit.solve(prior(), NOISE).log_evidence


def test_log_evidence_of_linearised_rows_is_stationary() -> None:
    """Of normal equations, in the sizes of all groups that the data determine, and in both noises."""
    case = poses()
    fit = NormalEquations.from_rows(case.design, case.rows)
    found = fit.maximise_evidence(case.prior, case.noise, 300, 1e-9)
    moving = (
        (found.prior.group_scales > 10 * SMALLEST_SIZE)
        .nonzero()[found.prior.geometric_class_count :, 0]
        .tolist()
    )
    assert moving
    step, slopes = 1e-3, []
    for number in [*moving, -1, -2]:
        ends = []
        for sign in (1, -1):
            sizes, noise = found.prior.group_scales.clone(), list(found.noise)
            if number < 0:
                noise[number] *= math.exp(sign * step)
            else:
                sizes[number] *= math.exp(sign * step)
            ends.append(fit.solve(replace(found.prior, group_scales=sizes), tuple(noise)).log_evidence)
        slopes.append((ends[0] - ends[1]) / (2 * step))
    assert_close(np.array(slopes), 0.0, atol=1e-2)


def test_more_updates_never_worsen_a_converged_search() -> None:
    X, y = problem(rows=60)
    fit = DenseRegression.between(X, y)
    few, many = (fit.maximise_evidence(prior(), NOISE, count, 0.0) for count in (10, 400))
    assert many.log_evidence >= few.log_evidence - 1e-9
    settled = fit.maximise_evidence(prior(), NOISE, 400, 1e-3)
    assert settled.log_evidence < many.log_evidence
    assert_close(settled.log_evidence, many.log_evidence, atol=0.1)


def test_no_updates_are_the_posterior_as_it_is() -> None:
    fit = DenseRegression.between(*problem())
    found = fit.maximise_evidence(prior(), NOISE, 0)
    assert_close(found.prior.group_scales, prior().group_scales)
    assert found.noise == NOISE
    assert found.log_evidence == fit.solve(prior(), NOISE).log_evidence


def test_groups_without_effect_go_to_the_floor_and_the_others_do_not() -> None:
    """Of targets that are orthogonal to a group's columns, once the other unknowns are out."""
    X = normal(200, 8, seed=1)
    X = torch.linalg.qr(X)[0] * 200**0.5
    quiet = GROUP == 2
    noise = normal(200, seed=3)
    noise = noise - X @ torch.linalg.lstsq(X, noise).solution
    y = X[:, ~quiet] @ normal(int((~quiet).sum()), seed=2) + 0.1 * noise
    found = DenseRegression.between([X], [y]).maximise_evidence(prior(), (0.5,), 100, 0.0)
    assert_close(found.prior.group_scales[2], SMALLEST_SIZE, rtol=1e-6)
    assert float(found.prior.group_scales[:2].min()) > 0.1
    assert_close(found.x[quiet], torch.zeros(3), atol=1e-12)
    assert_close(found.noise[0], float(y.sub(X @ found.x).norm()) / math.sqrt(200 - 5), rtol=1e-3)


def test_sizes_of_classes_of_geometric_parameters_are_kept() -> None:
    """The geometric calibration has found them; those of the weights move."""
    X, y = problem()
    found = DenseRegression.between(X, y).maximise_evidence(prior(classes=2), NOISE).prior.group_scales
    assert_close(found[:2], prior().group_scales[:2])
    assert float((found[2] / prior().group_scales[2]).log().abs()) > 1e-3


def test_sizes_that_no_data_determine_are_kept() -> None:
    X, y = problem()
    X = [columns * (GROUP != 1) for columns in X]
    found = DenseRegression.between(X, y).maximise_evidence(prior(), NOISE, 30, 0.0)
    assert float(found.prior.group_scales[1]) == 1.5
    assert_close(found.x[GROUP == 1], torch.zeros(3))


def test_estimated_noise_never_falls_below_the_stated_noise() -> None:
    X, y = problem()
    scaled = [part / sigma for part, sigma in zip(X, NOISE, strict=True)]
    small = [0.3 * target / sigma for target, sigma in zip(y, NOISE, strict=True)]
    fit = DenseRegression.between(scaled, small, stated=(True, False))
    found = fit.updated_noise(fit.solve(prior(), (1.0, 1.0)))
    assert found[0] == 1.0
    assert 0.1 < found[1] < 0.6
    more = [10 * target for target in small]
    large = DenseRegression.between(scaled, more, stated=(True, True))
    posterior = large.solve(prior(), (1.0, 1.0))
    assert large.updated_noise(posterior)[0] > 2.0
    exact = DenseRegression.between(scaled, more, stated=(True, True), exact=(True, False))
    assert exact.updated_noise(posterior)[0] == 1.0


def test_noise_is_the_misfit_over_the_values_that_the_unknowns_leave() -> None:
    fit = DenseRegression.between(*problem())
    posterior = fit.solve(prior(), NOISE)
    C, X = covariance_of(fit, posterior), fit.X[:30] / NOISE[0]
    residual = fit.y[:30] - fit.X[:30] @ posterior.x
    used = float(((X @ C) * X).sum())
    assert_close(posterior.effective_parameters[0], used, rtol=1e-10)
    expected = math.sqrt(float(residual.square().sum()) / (30 - used))
    assert_close(fit.updated_noise(posterior)[0], expected, rtol=1e-10)


def test_share_of_the_values_that_are_used_up_counts_what_is_measured() -> None:
    X, y = problem()
    fit = DenseRegression.between(X, y)
    posterior = fit.solve(prior(), NOISE)
    assert_close(fit.absorbed_share(posterior), posterior.effective_unknowns / 45, rtol=1e-12)
    known = DenseRegression.between(X, y, exact=(False, True))
    assert_close(known.absorbed_share(posterior), posterior.effective_unknowns / 30, rtol=1e-12)
