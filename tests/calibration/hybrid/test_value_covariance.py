"""The regression by the values' covariance against normal equations and the dense problem."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.dense_regression import DenseRegression
from testing.posteriors import assert_same_posterior
from testing.regression_cases import CASES, few_values

from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.regression import NormalEquations, ValueCovariance
from pisigma.files.errors import IdentificationError


@pytest.mark.parametrize("name", CASES)
def test_posterior_is_that_of_the_dense_problem_and_of_normal_equations(name: str) -> None:
    case = CASES[name]()
    found = ValueCovariance.from_rows(case.design, case.rows)
    assert found.sensors == case.rows.sensors
    for expected in (case.dense, NormalEquations.from_rows(case.design, case.rows)):
        assert_same_posterior(found, expected, case.prior, case.noise, case.exactness)


@pytest.mark.parametrize("name", CASES)
def test_a_smaller_design_equals_one_built_directly(name: str) -> None:
    """Of fewer features, and of a series with fewer harmonics."""
    case = CASES[name]()
    small = Design(case.rows.problem, case.smaller)
    found, made = (
        ValueCovariance.from_rows(case.design, case.rows).select(small),
        ValueCovariance.from_rows(small, case.rows),
    )
    assert_close(found.X, made.X)
    assert_close(found.K, made.K, rtol=1e-12, atol=1e-12 * float(made.K.abs().max()))
    prior = small.prior_with_scales_of(case.design, case.prior)
    dense = DenseRegression.from_rows(small, case.rows)
    assert_same_posterior(found, dense, prior, case.noise, case.exactness)


def test_geometry_alone_has_no_matrices() -> None:
    case = few_values()
    geometry = Design(case.rows.problem, ())
    found = ValueCovariance.from_rows(case.design, case.rows).select(geometry)
    assert len(found.K) == 0
    dense = DenseRegression.from_rows(geometry, case.rows)
    assert_same_posterior(found, dense, geometry.prior((1.0,) * 4), case.noise, case.exactness)


@pytest.mark.parametrize("name", CASES)
def test_without_some_groups_it_is_that_of_the_others(name: str) -> None:
    """What is certain stays."""
    case = CASES[name]()
    groups = torch.cat(case.folds[1:])
    found, expected = (
        ValueCovariance.from_rows(case.design, case.rows).without_groups(groups),
        case.dense.without_groups(groups),
    )
    values = [np.array([one.values for one in form.sensors]) for form in (found, expected)]
    assert_close(values[0], values[1], rtol=1e-6)
    assert_close(found.X, expected.X)
    assert_close(found.y, expected.y)
    covariance, X = found._covariance(case.prior, case.noise), expected.X[:, case.design.active_count :]
    sigma = torch.tensor(case.noise, dtype=torch.float64)[expected.sensor]
    wanted = X / case.prior.precision[case.design.active_count :] @ X.t() + torch.diag(sigma.square())
    assert_close(covariance, wanted.triu(), atol=1e-12 * float(wanted.abs().max()))


def test_more_features_are_fitted_at_once() -> None:
    case = few_values()
    found = ValueCovariance.from_rows(case.design, case.rows)
    small = Design(case.rows.problem, case.design.features[:2])
    posterior = found.select(small).solve(small.prior((1.0,) * 4), case.noise)
    assert found.evidence_gain(posterior, small, case.design.features[2]) == (math.inf, None)


def test_values_that_are_not_finite_are_refused() -> None:
    case = few_values()
    found = ValueCovariance.from_rows(case.design, case.rows)
    found.X[3] = torch.nan
    with pytest.raises(IdentificationError):
        found.solve(case.prior, case.noise)


def test_noise_that_is_small_compared_with_the_values_uses_normal_equations() -> None:
    """Traces of P cancel there; what comes back is that of the normal equations to the last bit."""
    case = few_values()
    noise = tuple(1e-4 * sigma for sigma in case.noise)
    prior = replace(case.prior, group_scales=case.prior.group_scales * 10)
    dual, normal = (
        ValueCovariance.from_rows(case.design, case.rows),
        NormalEquations.from_rows(case.design, case.rows),
    )
    here, there = dual.solve(prior, noise), dual.normal_equations.solve(prior, noise)
    assert torch.equal(here.x, there.x)
    assert here.log_evidence == there.log_evidence
    expected = normal.solve(prior, noise)
    assert_close(here.determined_unknowns, expected.determined_unknowns, atol=1e-3)
    errors, wanted = dual.held_out_errors(here, case.folds), normal.held_out_errors(expected, case.folds)
    assert_close(errors.error, wanted.error, rtol=1e-3, atol=1e-3 * float(wanted.error.abs().max()))
