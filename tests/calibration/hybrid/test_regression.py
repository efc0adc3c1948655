"""Which form of the regression is used for how many values."""

import pytest
import torch
from testing.closeness import assert_close
from testing.regression_cases import few_values, poses, several_targets

from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.regression import NormalEquations, ValueCovariance, build_regression


def test_few_values_of_many_unknowns_are_regressed_by_their_covariance() -> None:
    case = few_values()
    assert isinstance(build_regression(case.design, case.rows), ValueCovariance)
    geometry = Design(case.rows.problem, ())
    assert isinstance(build_regression(geometry, case.rows), NormalEquations)


@pytest.mark.parametrize("make", [poses, several_targets])
def test_more_values_than_unknowns_are_regressed_by_normal_equations(make) -> None:  # type: ignore[no-untyped-def]
    case = make()
    assert isinstance(build_regression(case.design, case.rows), NormalEquations)


def test_very_many_values_have_no_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be too large; the posterior is the same."""
    case = few_values()
    small = build_regression(case.design, case.rows)
    monkeypatch.setattr("pisigma.calibration.hybrid.regression.MAX_VALUES", 10)
    large = build_regression(case.design, case.rows)
    assert isinstance(large, NormalEquations)
    x, other = (fit.maximise_evidence(case.prior, case.noise).x for fit in (small, large))
    deviation = large.covariance_root(large.solve(case.prior, case.noise)).as_matrix.norm(dim=1)
    assert_close((x - other) / deviation, torch.zeros(len(x)), atol=1e-3)
