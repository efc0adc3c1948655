"""Left-out errors in closed form against fitting again without the rows."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.regression_cases import CASES, few_values, poses
from torch import Tensor

from pisigma.calibration.hybrid.design import AbstractDesignRegression
from pisigma.calibration.hybrid.regression import NormalEquations, ValueCovariance
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.regression import SensorValueCount

FORMS = {"normal equations": NormalEquations, "value covariance": ValueCovariance}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", CASES)
def test_closed_form_equals_fitting_without_every_group(name: str, form: str) -> None:
    """Where nothing else says where sockets of a placement or an anchor are, that is fitted to the held-out rows."""
    case = CASES[name]()
    fit: AbstractDesignRegression = FORMS[form].from_rows(case.design, case.rows)
    found = fit.held_out_errors(fit.solve(case.prior, case.noise), case.folds)
    expected = case.refitted
    assert found.sensor.tolist() == expected.sensor.tolist()
    assert len(found.error) >= len(case.folds)
    assert_close(found.error, expected.error, atol=1e-4 if name == "all kinds" else 1e-6)
    assert_close(found.predicted_sigma, expected.predicted_sigma, rtol=1e-4 if name == "all kinds" else 1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_several_groups_can_be_held_out_together(form: str) -> None:
    case = poses()
    folds = case.rows.folds(4, 1000)
    assert sorted(torch.cat(folds).tolist()) == list(range(case.rows.groups))
    fit: AbstractDesignRegression = FORMS[form].from_rows(case.design, case.rows)
    found = fit.held_out_errors(fit.solve(case.prior, case.noise), folds)
    expected = case.dense.held_out_errors(case.dense.solve(case.prior, case.noise), folds)
    assert_close(found.error, expected.error, atol=1e-6)
    assert_close(found.predicted_sigma, expected.predicted_sigma, rtol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_sizes_and_noise_can_be_estimated_for_every_fold(form: str) -> None:
    case = poses()
    folds = case.rows.folds(3, 1000)
    fit: AbstractDesignRegression = FORMS[form].from_rows(case.design, case.rows)
    found = fit.held_out_errors_refitted(fit.solve(case.prior, case.noise), folds, 3)
    expected = case.dense.held_out_errors_refitted(case.dense.solve(case.prior, case.noise), folds, 3)
    assert_close(found.error, expected.error, atol=1e-4)
    assert_close(found.predicted_sigma, expected.predicted_sigma, rtol=1e-4)
    held = fit.held_out_errors(fit.solve(case.prior, case.noise), folds)
    assert float((held.error - found.error).abs().max()) > 1e-2


@pytest.mark.parametrize("form", FORMS)
def test_the_noise_of_a_sensor_is_kept_if_a_fold_holds_out_all_its_values(form: str) -> None:
    """All distances are from one anchor; without them nothing says how noisy they are."""
    case = CASES["all kinds"]()
    number = [values.name for values in case.rows.values].index("distance")
    wire = case.rows.group[case.rows.values[number].row].unique()
    assert len(wire) == 1
    fit: AbstractDesignRegression = FORMS[form].from_rows(case.design, case.rows)
    posterior = fit.solve(case.prior, case.noise)
    rest = fit.without_groups(wire).maximise_evidence(posterior.prior, posterior.noise, 2)
    assert rest.noise[number] == case.noise[number]
    errors = fit.held_out_errors_refitted(posterior, [wire], 2)
    assert float(errors.error.square().mean()) < 4.0


def test_errors_are_larger_than_the_residuals_and_about_as_large_as_predicted() -> None:
    case = few_values()
    fit = ValueCovariance.from_rows(case.design, case.rows)
    posterior = fit.maximise_evidence(case.prior, case.noise)
    found = fit.held_out_errors(posterior, case.folds)
    residual = sum(m / sigma**2 for m, sigma in zip(posterior.misfit, posterior.noise, strict=True))
    assert float(found.error.square().sum()) > residual
    assert float(found.predicted_sigma.min()) >= 1.0
    assert 0.5 < float((found.error / found.predicted_sigma).square().mean()) < 2.0


def test_placements_of_sockets_and_anchors_are_among_what_is_held_out() -> None:
    """All values of three placements of two sockets each, and of a wire; of none of what is certain."""
    case = CASES["all kinds"]()
    names = [values.name for values in case.rows.values]
    count = torch.bincount(case.refitted.sensor, minlength=len(names)).tolist()
    assert count[names.index("socket")] == case.rows.values[names.index("socket")].residual.numel()
    assert count[names.index("distance")] == 80
    assert count[names.index("socket distance")] == 0


def residuals(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Columns of unknowns that only these values determine, a covariance, and values."""
    generator = torch.Generator().manual_seed(seed)
    Z, A = (torch.randn(count, k, generator=generator, dtype=torch.float64) for k in (2, count))
    return Z, torch.eye(count).double() + 0.1 * A @ A.t(), torch.randn(count, generator=generator).double()


def test_parameters_determined_only_by_held_out_values_are_treated_as_fitted() -> None:
    """By least squares; errors are scaled to what as many values would show that nothing is fitted to."""
    Z, S, y = residuals(8)
    inverse = torch.linalg.inv(S)
    M = inverse - inverse @ Z @ torch.linalg.inv(Z.t() @ inverse @ Z) @ Z.t() @ inverse
    sensor = torch.zeros(8, dtype=torch.int64)
    counts = [SensorValueCount(8.0, False, False)]
    found = HeldOutErrors.from_fit(M, M @ y, sensor, counts)
    expected = (y - Z @ torch.linalg.lstsq(Z, y).solution) * (8 / 6) ** 0.5
    assert_close(found.error, expected, atol=1e-9)
    free = torch.eye(8).double() - Z @ torch.linalg.pinv(Z)
    spread = (free @ S @ free).diagonal().clamp(min=1.0).sqrt()
    assert_close(found.predicted_sigma, spread, rtol=1e-9)


def test_downweighted_values_have_larger_errors_than_their_weight() -> None:
    """Counted as a third, a value has three times the variance of noise that its weight says."""
    _, S, y = residuals(6, 1)
    sensor = torch.tensor([0, 0, 0, 1, 1, 1])
    counts = [SensorValueCount(3.0, False, False), SensorValueCount(1.0, False, False, 3.0)]
    M = torch.linalg.inv(S)
    alone = HeldOutErrors.from_fit(
        M, M @ y, sensor, [counts[0], replace(counts[1], repeat_variance_factor=1.0)]
    )
    found = HeldOutErrors.from_fit(M, M @ y, sensor, counts)
    assert_close(alone.error, y, atol=1e-12)
    assert_close(alone.predicted_sigma, S.diagonal().sqrt(), rtol=1e-12)
    assert_close(found.error[:3], alone.error[:3])
    assert_close(found.error[3:], 3**0.5 * alone.error[3:], rtol=1e-12)
    assert_close(
        found.predicted_sigma[3:].square() - 1, 3 * (alone.predicted_sigma[3:].square() - 1), rtol=1e-12
    )


def test_root_mean_square_can_be_counted_in_another_noise() -> None:
    sensor = torch.tensor([0, 0, 1])
    errors = HeldOutErrors(torch.tensor([3.0, 4.0, 5.0]).double(), torch.ones(3).double(), sensor)
    assert_close(errors.rms((1.0, 1.0), (1.0, 1.0)), (50 / 3) ** 0.5, rtol=1e-14)
    assert_close(errors.rms((1.0, 2.0), (1.0, 1.0)), (125 / 3) ** 0.5, rtol=1e-14)
    assert_close(errors.rms((1.0, 2.0), (2.0, 4.0)), (12.5 / 3) ** 0.5, rtol=1e-14)
