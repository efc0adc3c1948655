"""The budget agrees with the published example of the GUM, with its formulas, and with drawn errors."""

import math

import numpy as np
import pytest
from scipy import stats
from testing.closeness import assert_close

from pisigma.validation.uncertainty.budget import Component, UncertaintyBudget


def budget(*components):
    return UncertaintyBudget(tuple(Component("", "A", u, freedom, "") for u, freedom in components))


def test_the_end_gauge_of_the_gum():
    """JCGM 100:2008, H.1: 32 nm with 16 effective degrees of freedom, and k = 2.92 for 99 %."""
    gauge = budget((25e-9, 18), (9.7e-9, 25.6), (2.9e-9, 50), (16.6e-9, 2))
    assert round(gauge.combined_uncertainty * 1e9) == 32
    assert math.floor(gauge.effective_degrees_of_freedom) == 16
    assert_close(stats.t.ppf(0.995, math.floor(gauge.effective_degrees_of_freedom)), 2.92, atol=0.005)


def test_the_combined_figures_are_those_of_the_formulas():
    u, freedom = np.array([0.018, 0.031, 0.015]), np.array([93.0, 93.0, np.inf])
    found = budget(*zip(u.tolist(), freedom.tolist(), strict=True))
    combined = np.linalg.norm(u)
    effective = combined**4 / np.sum(u**4 / freedom)
    assert_close(found.combined_uncertainty, combined, rtol=1e-12)
    assert_close(found.effective_degrees_of_freedom, effective, rtol=1e-12)
    assert_close(found.coverage_factor, stats.t.ppf(0.975, effective), rtol=1e-12)
    assert_close(found.expanded_uncertainty, found.coverage_factor * combined, rtol=1e-12)


def test_exact_components_have_the_factors_of_the_normal_distribution():
    found = budget((0.03, math.inf), (0.04, None))
    assert found.effective_degrees_of_freedom == math.inf
    assert_close(found.combined_uncertainty, 0.05, rtol=1e-12)
    assert_close(found.coverage_factor, 1.959964, atol=1e-6)
    assert_close(found.coverage_radius / found.combined_uncertainty, 2.795483, atol=1e-6)
    assert found.to_json()["effective_degrees_of_freedom"] == "infinite"


@pytest.mark.parametrize("freedom", [3, 12, 1000])
def test_coordinates_and_positions_are_covered(freedom):
    """Of errors whose standard deviation was estimated from as many other errors, 95 % are covered."""
    rng = np.random.default_rng(1)
    estimated = np.sqrt(rng.chisquare(freedom, 100_000) / freedom)
    errors = rng.normal(size=(100_000, 3))
    one = budget((1.0, freedom))
    assert_close(np.mean(np.abs(errors[:, 0]) < one.expanded_uncertainty * estimated), 0.95, atol=0.004)
    assert_close(np.mean(np.linalg.norm(errors, axis=1) < one.coverage_radius * estimated), 0.95, atol=0.004)


def test_without_components_there_are_no_combined_figures():
    found = UncertaintyBudget((), ("instrument: not stated.",)).to_json()
    assert found == {"components": [], "not_stated": ["instrument: not stated."]}
