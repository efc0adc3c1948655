"""Regions and binned errors of a report, against numpy and planted errors."""

import numpy as np
import pytest
from testing.closeness import assert_close

from pisigma.validation.held_out.rank_tests import SIGNIFICANT
from pisigma.validation.report.dependence import bin_errors
from pisigma.validation.report.error_map import CELLS, worst_region


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


def test_chance_gives_no_significant_region():
    found = [
        worst_region(rng.uniform(0, 1, (800, 3)), rng.normal(size=800) ** 2)
        for rng in map(np.random.default_rng, range(20))
    ]
    assert sum(region.significant for region in found) == 0
    assert SIGNIFICANT * 20 < 0.5  # so that none was to be expected


@pytest.mark.parametrize("rows", [0, 1, 5])
def test_too_few_rows_give_no_region(rows):
    assert worst_region(np.zeros((rows, 3)), np.ones(rows)) is None


def test_a_plane_of_places_has_cells():
    place = np.random.default_rng(0).uniform(size=(500, 3)) * [1, 1, 0]
    region = worst_region(place, np.ones(500))
    assert region is not None
    assert region.rows >= 500 // CELLS**2 // 2


def test_binned_errors_are_root_mean_squares():
    rng = np.random.default_rng(0)
    values, errors = rng.uniform(-3, 5, 600), rng.normal(size=600)
    found = bin_errors(values, errors)
    for k, rms in enumerate(found.rms):
        low, high = found.edges[k : k + 2]
        own = (values >= low) & ((values < high) | (k == len(found.rms) - 1))
        assert_close(rms, np.sqrt((errors[own] ** 2).mean()), rtol=1e-12)
    assert len(bin_errors(np.ones(3), np.ones(3)).rms) == 1
