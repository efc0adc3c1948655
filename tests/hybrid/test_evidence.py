"""Posterior, log evidence and prior sizes against the direct formulas of a normal density."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from testing.closeness import assert_close
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.hybrid.evidence import (
    SMALLEST_SIZE,
    GaussianPrior,
    Sums,
    maximise_evidence,
    misfits,
    renewed_noise,
    solve_mean,
    solve_posterior,
)
from pisigma.identification.problem.noise import SMALLEST_PRIOR

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


def sums_of(X: list[Tensor], y: list[Tensor], known: tuple[bool, ...] = (False, False)) -> Sums:
    return Sums(
        torch.stack([columns.t() @ columns for columns in X]),
        torch.stack([columns.t() @ target for columns, target in zip(X, y, strict=True)]),
        tuple(float(target @ target) for target in y),
        tuple(float(len(target)) for target in y),
        known,
        (False,) * len(y),
    )


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
    found = solve_posterior(sums_of(X, y), prior(), NOISE)
    columns, targets = (
        np.concatenate([(part / sigma).numpy() for part, sigma in zip(parts, NOISE, strict=True)])
        for parts in (X, y)
    )
    covariance = np.linalg.inv(columns.T @ columns + np.diag(prior().precision.numpy()))
    assert_close(found.covariance, covariance, atol=1e-12)
    assert_close(found.x, covariance @ columns.T @ targets, atol=1e-12)
    assert_close(solve_mean(sums_of(X, y), prior(), NOISE), found.x, atol=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_log_evidence_is_the_marginal_density_up_to_a_constant_of_the_data(seed: int) -> None:
    X, y = problem(seed)
    constant = 0.5 * sum(map(len, y)) * math.log(2 * math.pi)
    for sizes, noise in (((0.7, 1.5, 0.4), NOISE), ((3.0, 0.1, 1e-3), (0.2, 2.0))):
        found = solve_posterior(sums_of(X, y), prior(sizes), noise).log_evidence
        assert_close(found, marginal(X, y, prior(sizes).precision, noise) + constant, atol=1e-7)


def test_unknowns_without_a_prior_add_a_constant_to_the_log_evidence() -> None:
    """It is the limit of a prior that gets ever wider, less what its width alone comes to."""
    X, y = problem()
    known, wide = prior(), 1e-6
    flat = replace(known, base=torch.where(GROUP == 0, 0.0, known.base))
    precision = torch.where(GROUP == 0, wide, known.precision)
    constant = 0.5 * sum(map(len, y)) * math.log(2 * math.pi) - 0.5 * 2 * math.log(wide)
    found = solve_posterior(sums_of(X, y), flat, NOISE).log_evidence
    assert_close(found, marginal(X, y, precision, NOISE) + constant, atol=1e-4)


def test_misfits_are_the_squared_residuals() -> None:
    X, y = problem()
    x = normal(8, seed=7)
    expected = [float((target - columns @ x).square().sum()) for columns, target in zip(X, y, strict=True)]
    assert_close(np.array(misfits(sums_of(X, y), x)), np.array(expected), rtol=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_log_evidence_is_stationary_in_sizes_and_noise(seed: int) -> None:
    X, y = problem(seed, rows=60)
    sums = sums_of(X, y)
    found = maximise_evidence(sums, prior(), NOISE, iterations=500, tolerance=0.0)
    assert found.iterations == 500

    def evidence(log_change: Tensor) -> float:
        sizes = found.prior.sizes * log_change[:3].exp()
        noise = tuple(
            sigma * math.exp(change)
            for sigma, change in zip(found.noise, log_change[3:].tolist(), strict=True)
        )
        return solve_posterior(sums, replace(found.prior, sizes=sizes), noise).log_evidence

    step = 1e-4
    slopes = []
    for k in range(5):
        change = torch.zeros(5, dtype=torch.float64)
        change[k] = step
        slopes.append((evidence(change) - evidence(-change)) / (2 * step))
    assert_close(np.array(slopes), 0.0, atol=1e-4)
    assert found.log_evidence > solve_posterior(sums, prior(), NOISE).log_evidence


def test_more_updates_never_make_a_settled_search_worse() -> None:
    X, y = problem(rows=60)
    few, many = (maximise_evidence(sums_of(X, y), prior(), NOISE, count, 0.0) for count in (10, 400))
    assert many.log_evidence >= few.log_evidence - 1e-9
    settled = maximise_evidence(sums_of(X, y), prior(), NOISE, 400, 1e-3)
    assert settled.iterations < 400
    assert_close(settled.log_evidence, many.log_evidence, atol=0.1)


def test_groups_without_effect_go_to_the_floor_and_the_others_do_not() -> None:
    """Of targets that are orthogonal to a group's columns, once the other unknowns are out."""
    X = normal(200, 8, seed=1)
    X = torch.linalg.qr(X)[0] * 200**0.5
    quiet = GROUP == 2
    noise = normal(200, seed=3)
    noise = noise - X @ torch.linalg.lstsq(X, noise).solution
    y = X[:, ~quiet] @ normal(int((~quiet).sum()), seed=2) + 0.1 * noise
    found = maximise_evidence(sums_of([X], [y]), prior(), (0.5,), 100, 0.0)
    assert_close(found.prior.sizes[2], SMALLEST_SIZE, rtol=1e-6)
    assert float(found.prior.sizes[:2].min()) > 0.1
    assert_close(found.x[quiet], torch.zeros(3), atol=1e-12)
    assert_close(found.noise[0], float(y.sub(X @ found.x).norm()) / math.sqrt(200 - 5), rtol=1e-3)


def test_sizes_of_classes_keep_their_limits_and_stand_where_they_are_fixed() -> None:
    X, y = problem()
    nothing = [torch.zeros_like(target) for target in y]
    shrunk = maximise_evidence(sums_of(X, nothing), prior(classes=2), NOISE, 50, 0.0).prior.sizes
    assert_close(shrunk, torch.tensor([SMALLEST_PRIOR, SMALLEST_PRIOR, SMALLEST_SIZE]).double(), rtol=1e-6)
    fixed = maximise_evidence(sums_of(X, y), prior(classes=2, fixed=True), NOISE).prior.sizes
    assert_close(fixed[:2], prior().sizes[:2])
    assert float((fixed[2] / prior().sizes[2]).log().abs()) > 1e-3
    standing = maximise_evidence(sums_of(X, y), prior(standing=(1,)), NOISE).prior.sizes
    assert float(standing[1]) == 1.5
    assert float(standing[0]) != 0.7


def test_sizes_of_which_nothing_is_told_stand() -> None:
    X, y = problem()
    X = [columns * (GROUP != 1) for columns in X]
    found = maximise_evidence(sums_of(X, y), prior(), NOISE, 30, 0.0)
    assert float(found.prior.sizes[1]) == 1.5
    assert_close(found.x[GROUP == 1], torch.zeros(3))


def test_noise_that_is_given_falls_below_it_never_and_of_what_is_certain_not_at_all() -> None:
    X, y = problem()
    scaled = [part / sigma for part, sigma in zip(X, NOISE, strict=True)]
    small = [0.3 * target / sigma for target, sigma in zip(y, NOISE, strict=True)]
    sums = sums_of(scaled, small, (True, False))
    found = renewed_noise(sums, solve_posterior(sums, prior(), (1.0, 1.0)))
    assert found[0] == 1.0
    assert 0.1 < found[1] < 0.6
    large = sums_of(scaled, [10 * target for target in small], (True, True))
    posterior = solve_posterior(large, prior(), (1.0, 1.0))
    assert renewed_noise(large, posterior)[0] > 2.0
    assert renewed_noise(replace(large, exact=(True, False)), posterior)[0] == 1.0


def test_sums_without_some_rows_are_the_sums_of_the_others() -> None:
    X, y = problem()
    whole = sums_of(X, y)
    part = sums_of([columns[::3] for columns in X], [target[::3] for target in y])
    left = [torch.arange(len(target)) % 3 != 0 for target in y]
    rest = sums_of(*([part[keep] for part, keep in zip(parts, left, strict=True)] for parts in (X, y)))
    found = whole.minus(part)
    assert_close(found.normal, rest.normal, atol=1e-11)
    assert_close(found.descent, rest.descent, atol=1e-11)
    assert_close(np.array(found.square), np.array(rest.square), rtol=1e-11)
    assert found.count == rest.count


def test_sums_and_prior_of_some_unknowns_are_those_of_their_columns() -> None:
    X, y = problem()
    chosen = torch.tensor([7, 1, 2])
    found, own = sums_of(X, y).select(chosen), sums_of([columns[:, chosen] for columns in X], y)
    assert_close(found.normal, own.normal, atol=1e-12)
    assert_close(found.descent, own.descent, atol=1e-12)
    assert_close(prior().select(chosen).precision, prior().precision[chosen])


def test_equal_columns_without_a_prior_are_still_solved() -> None:
    X, y = problem()
    twice = [torch.cat([columns, columns[:, :1] * 1e-6], 1) for columns in X]
    flat = GaussianPrior(
        torch.zeros(9).double(), torch.zeros(9, dtype=torch.int64), torch.ones(1).double(), 0
    )
    x = solve_mean(sums_of(twice, y), flat, (1.0, 1.0))
    best = torch.linalg.lstsq(torch.cat(X), torch.cat(y)).solution
    assert_close(torch.cat(twice) @ x, torch.cat(X) @ best, atol=1e-5)


def test_values_that_are_not_finite_are_refused() -> None:
    X, y = problem()
    broken = sums_of([X[0] * float("nan"), X[1]], y)
    with pytest.raises(IdentificationError, match="not finite"):
        solve_posterior(broken, prior(), NOISE)
