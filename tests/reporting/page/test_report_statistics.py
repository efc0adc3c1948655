"""Rank tests and regions of a report, against scipy, numpy and planted errors."""

import numpy as np
import pytest
import scipy.stats
from testing.closeness import assert_close

from pisigma.judging.rank_tests import SIGNIFICANT, groups_differ, rank_correlation, ranks
from pisigma.reporting.page.regions import CELLS, binned, worst_region


@pytest.mark.parametrize("digits", [1, 2, 12])
def test_ranks_and_correlation_are_scipys(digits):
    rng = np.random.default_rng(0)
    x = rng.normal(size=400).round(digits)
    y = (x + rng.normal(size=400)).round(digits)
    assert_close(ranks(x), scipy.stats.rankdata(x), atol=0)
    r, chance = rank_correlation(x, y)
    assert_close(r, scipy.stats.spearmanr(x, y).statistic, atol=1e-12)
    assert_close(chance, 2 * scipy.stats.norm.sf(abs(r) * np.sqrt(399)), rtol=1e-9)


@pytest.mark.parametrize("groups", [2, 7])
def test_groups_differ_is_scipys_test(groups):
    rng = np.random.default_rng(1)
    number = rng.integers(0, groups, 300)
    values = (rng.normal(size=300) + 0.2 * number).round(1)
    H, chance = groups_differ(number * 3, values)  # numbers without a group in between
    expected = scipy.stats.kruskal(*(values[number == k] for k in range(groups)))
    assert_close(H, expected.statistic, rtol=1e-12)
    assert_close(chance, expected.pvalue, rtol=1e-9)


def test_nothing_to_compare_is_chance():
    assert rank_correlation(np.ones(9), np.arange(9.0)) == (0.0, 1.0)
    assert rank_correlation(np.arange(2.0), np.arange(2.0)) == (0.0, 1.0)
    assert groups_differ(np.zeros(9, dtype=int), np.arange(9.0)) == (0.0, 1.0)
    assert groups_differ(np.arange(9) % 2, np.ones(9)) == (0.0, 1.0)


def test_a_planted_region_is_found():
    rng = np.random.default_rng(2)
    place = rng.uniform(0, 1, (4000, 3))
    errors = rng.uniform(0.5, 1.5, 4000)
    planted = (place > 0.75).all(1)
    errors[planted] *= 3
    region = worst_region(place, errors)
    assert region is not None
    assert region.significant
    assert min(region.low) > 0.7
    inside = ((place >= region.low) & (place <= np.array(region.high) + 1e-12)).all(1)
    assert region.rows == int(inside.sum())
    assert_close(region.rms, np.sqrt((errors[inside] ** 2).mean()), rtol=1e-12)
    assert_close(region.ratio, region.rms / np.sqrt((errors**2).mean()), rtol=1e-12)


def test_chance_plants_no_region():
    found = [
        worst_region(rng.uniform(0, 1, (800, 3)), rng.normal(size=800) ** 2)
        for rng in map(np.random.default_rng, range(20))
    ]
    assert sum(region.significant for region in found) == 0
    assert SIGNIFICANT * 20 < 0.5  # so that none was to be expected


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_too_few_rows_have_no_region(rows):
    assert worst_region(np.zeros((rows, 3)), np.ones(rows)) is None


def test_a_plane_of_places_has_cells():
    place = np.random.default_rng(0).uniform(size=(500, 3)) * [1, 1, 0]
    region = worst_region(place, np.ones(500))
    assert region is not None
    assert region.rows >= 500 // CELLS**2 // 2


def test_binned_errors_are_root_mean_squares():
    rng = np.random.default_rng(0)
    values, errors = rng.uniform(-3, 5, 600), rng.normal(size=600)
    found = binned(values, errors)
    for k, rms in enumerate(found.rms):
        low, high = found.edges[k : k + 2]
        own = (values >= low) & ((values < high) | (k == len(found.rms) - 1))
        assert_close(rms, np.sqrt((errors[own] ** 2).mean()), rtol=1e-12)
    assert len(binned(np.ones(3), np.ones(3)).rms) == 1
