"""Two populations of residuals are told from one, whatever its shape."""

import numpy as np
import pytest
from testing.closeness import assert_close

from pisigma.verification.checks.two_populations import two_populations


@pytest.mark.parametrize("components", [1, 3])
def test_one_population_is_one(components):
    rng = np.random.default_rng(0)
    residuals = rng.normal(size=(200, components)) * 10.0 ** -np.arange(components)
    assert not two_populations(residuals).apart
    assert not two_populations(np.zeros((30, components))).apart


def test_errors_of_a_gear_along_one_axis_are_one_population():
    rng = np.random.default_rng(0)
    residuals = 0.1 * rng.normal(size=(200, 3))
    residuals[:, 2] += np.sin(rng.uniform(0, 7, 200))
    assert not two_populations(residuals).apart


@pytest.mark.parametrize("same", [True, False])
def test_wrong_rows_are_told_from_right_ones(same):
    rng = np.random.default_rng(0)
    residuals = 0.1 * rng.normal(size=(200, 3))
    residuals[:80] += [3.0, 0, 0] if same else 1.7 * rng.normal(size=(80, 3))
    mixture = two_populations(residuals)
    assert mixture.apart
    assert_close(mixture.share, 0.4, atol=0.02)
    assert_close(mixture.scatter, 0.1, rtol=0.15)
    assert_close(mixture.off, 1.7, rtol=0.15)
