"""Compares what two forms of a regression say."""

from dataclasses import replace

import numpy as np
from testing.closeness import assert_close
from torch import Tensor

from pisigma.calibration.hybrid.abstract_regression import AbstractRegression
from pisigma.calibration.hybrid.evidence import GaussianPrior, Posterior


def covariance(fit: AbstractRegression, posterior: Posterior) -> Tensor:
    """Covariance of the unknowns, from its root."""
    root = fit.covariance_root(posterior).dense
    return root @ root.t()


def assert_same_posterior(
    found: AbstractRegression,
    expected: AbstractRegression,
    prior: GaussianPrior,
    noise: tuple[float, ...],
    exactness: float,
) -> None:
    """Unknowns and covariance in units of the standard deviations, and all sums, under two priors and noises.

    Args:
        found: to be looked at.
        expected: what it has to equal.
        prior: of the unknowns; the second one is narrower.
        noise: per sensor; the second one is larger.
        exactness: of the unknowns.
    """
    narrow = replace(prior, sizes=prior.sizes / 3)
    ways = ((prior, noise), (narrow, tuple(2 * sigma for sigma in noise)))
    evidence = []
    for own, sigma in ways:
        here, there = found.solve(own, sigma), expected.solve(own, sigma)
        assert here.noise == sigma
        C = covariance(expected, there)
        deviation = C.diagonal().sqrt()
        correlation = C / deviation / deviation[:, None]
        assert_close((here.x - there.x) / deviation, np.zeros(len(deviation)), atol=exactness)
        assert_close(
            covariance(found, here) / deviation / deviation[:, None], correlation, atol=max(exactness, 1e-6)
        )
        assert_close(here.square, there.square, rtol=exactness, atol=1e-9)
        assert_close(here.determined, there.determined, atol=max(exactness, 1e-6))
        assert_close(np.array(here.misfit), np.array(there.misfit), rtol=exactness)
        assert_close(np.array(here.used), np.array(there.used), rtol=exactness, atol=1e-6)
        assert_close(here.effective, there.effective, atol=max(exactness, 1e-6))
        evidence.append((here.log_evidence, there.log_evidence))
    here, there = (second - first for first, second in zip(*evidence, strict=True))
    assert_close(here, there, rtol=max(exactness, 1e-6))
