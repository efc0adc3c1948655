"""Comparison of the results of two forms of a regression."""

from dataclasses import replace

import numpy as np
from testing.closeness import assert_close
from torch import Tensor

from pisigma.calibration.hybrid.design import AbstractDesignRegression
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import Posterior


def covariance(fit: AbstractDesignRegression, posterior: Posterior) -> Tensor:
    """Compute the covariance of the unknowns from its root."""
    root = fit.covariance_root(posterior).as_matrix
    return root @ root.t()


def assert_same_posterior(
    found: AbstractDesignRegression,
    expected: AbstractDesignRegression,
    prior: GaussianPrior,
    noise: tuple[float, ...],
    exactness: float,
) -> None:
    """Compare unknowns and covariance in units of the standard deviations, and all sums, for two priors and noises.

    Args:
        found: the regression under test.
        expected: the reference.
        prior: priors of the unknowns; the second one is narrower.
        noise: noise per sensor; the second one is larger.
        exactness: tolerance of the unknowns in standard deviations.
    """
    narrow = replace(prior, group_scales=prior.group_scales / 3)
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
        assert_close(here.squared_unknowns, there.squared_unknowns, rtol=exactness, atol=1e-9)
        assert_close(here.determined_unknowns, there.determined_unknowns, atol=max(exactness, 1e-6))
        assert_close(np.array(here.misfit), np.array(there.misfit), rtol=exactness)
        assert_close(
            np.array(here.effective_parameters),
            np.array(there.effective_parameters),
            rtol=exactness,
            atol=1e-6,
        )
        assert_close(here.effective_unknowns, there.effective_unknowns, atol=max(exactness, 1e-6))
        evidence.append((here.log_evidence, there.log_evidence))
    here, there = (second - first for first, second in zip(*evidence, strict=True))
    assert_close(here, there, rtol=max(exactness, 1e-6))
