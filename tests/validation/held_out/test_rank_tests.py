"""Rank tests: by hand and by their invariances, and where there is nothing to test."""

import math

import numpy as np
import pytest
from testing.closeness import assert_close

from pisigma.validation.held_out.rank_tests import SIGNIFICANT, kruskal_wallis, rank_correlation, signed_rank


def test_signed_rank_by_hand():
    # sizes 1, 2, 2, 3, 4 have the ranks 1, 2.5, 2.5, 4, 5; the zero is left out
    found = signed_rank(np.array([1.0, -2.0, 2.0, 0.0, 3.0, 4.0]))
    assert (found.pairs, found.statistic) == (5, 2.5)
    variance = 5 * 6 * 11 / 24 - (2**3 - 2) / 48
    assert_close(found.z, (2.5 - 7.5) / math.sqrt(variance), atol=1e-12)
    assert_close(found.p, math.erfc(5 / math.sqrt(2 * variance)), atol=1e-12)


def test_signed_rank_does_not_depend_on_the_direction():
    values = np.random.default_rng(0).normal(0.3, 1.0, 60).round(1)
    assert signed_rank(-values) == signed_rank(values)
    assert signed_rank(values).z < 0


def test_equal_models_do_not_differ():
    found = signed_rank(np.zeros(4))
    assert (found.statistic, found.z, found.p, found.pairs) == (0.0, 0.0, 1.0, 0)


def test_rank_correlation_is_that_of_the_ranks():
    rng = np.random.default_rng(0)
    x = rng.normal(size=400)
    y = x + rng.normal(size=400)
    r, chance = rank_correlation(x, y)
    ranks = [values.argsort().argsort() for values in (x, y)]
    assert_close(r, np.corrcoef(*ranks)[0, 1], atol=1e-12)
    assert chance < SIGNIFICANT
    assert_close(rank_correlation(np.exp(x), y**3)[0], r, atol=1e-12)
    assert rank_correlation(x, rng.normal(size=400))[1] > SIGNIFICANT


def test_groups_differ_by_hand():
    # ranks 1 2 3 against 4 5 6: H = 12 / (6 · 7) · (6² / 3 + 15² / 3) - 3 · 7
    H, chance = kruskal_wallis(np.array([5, 5, 5, 9, 9, 9]), np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    assert_close(H, 12 / 42 * (36 / 3 + 225 / 3) - 21, atol=1e-12)
    assert_close(chance, math.erfc(math.sqrt(H / 2)), atol=1e-12)


@pytest.mark.parametrize("x", [np.ones(9), np.arange(2.0)])
def test_nothing_to_compare_is_chance(x):
    assert rank_correlation(x, np.arange(float(len(x)))) == (0.0, 1.0)
    assert kruskal_wallis(np.zeros(9, dtype=int), np.arange(9.0)) == (0.0, 1.0)
    assert kruskal_wallis(np.arange(9) % 2, np.ones(9)) == (0.0, 1.0)
