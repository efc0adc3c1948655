"""Primal and dual regression compared with scikit-learn and with exact formulas in 50 digits."""

import math
from dataclasses import replace

import mpmath
import pytest
import torch
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, DotProduct
from sklearn.linear_model import BayesianRidge
from testing.closeness import assert_close
from torch import Tensor

from pisigma.estimation.dual_regression import DualRegression, group_gram, stack_groups
from pisigma.estimation.primal_regression import PrimalRegression
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import AbstractRegression, SensorValueCount

VALUES, WEIGHTS = 30, 6


def random_case(values: int = VALUES, parameters: int = 0) -> tuple[Tensor, Tensor, GaussianPrior]:
    """Return columns, values and a prior: parameters without a prior, then weights of one size."""
    generator = torch.Generator().manual_seed(3)
    X = torch.randn(values, parameters + WEIGHTS, generator=generator, dtype=torch.float64)
    x = torch.randn(parameters + WEIGHTS, generator=generator, dtype=torch.float64)
    y = X @ x + 0.3 * torch.randn(values, generator=generator, dtype=torch.float64)
    base = torch.cat([torch.zeros(parameters), torch.ones(WEIGHTS)]).double()
    group = torch.cat([torch.zeros(parameters), torch.ones(WEIGHTS)]).long()
    return X, y, GaussianPrior(base, group, torch.tensor([1.0, 0.7]).double(), 1)


def both_forms(X: Tensor, y: Tensor, prior: GaussianPrior) -> dict[str, AbstractRegression]:
    sensors = (SensorValueCount(float(len(y)), has_stated_noise=False, has_exact_noise=False),)
    active = int((prior.unit_precision == 0).sum())
    primal = PrimalRegression((X.t() @ X)[None], (X.t() @ y)[None], (float(y @ y),), sensors)
    K = stack_groups([group_gram(X, prior, 1, active)], y)
    sensor = torch.zeros(len(y), dtype=torch.int64)
    return {"primal": primal, "dual": DualRegression(X, y, sensor, prior, active, K, sensors)}


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_sizes_and_noise_by_the_evidence_are_those_of_bayesian_ridge(form: str):
    X, y, prior = random_case()
    peer = BayesianRidge(
        max_iter=2000, tol=1e-13, alpha_1=0.0, alpha_2=0.0, lambda_1=0.0, lambda_2=0.0, fit_intercept=False
    ).fit(X.numpy(), y.numpy())
    posterior = both_forms(X, y, prior)[form].maximise_evidence(prior, (0.5,), 500, 1e-13)
    assert_close(posterior.x, torch.from_numpy(peer.coef_), rtol=1e-6)
    assert posterior.noise[0] == pytest.approx(peer.alpha_**-0.5, rel=1e-6)
    assert float(posterior.prior.group_scales[1]) == pytest.approx(peer.lambda_**-0.5, rel=1e-5)


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_covariance_is_that_of_bayesian_ridge(form: str):
    X, y, prior = random_case()
    peer = BayesianRidge(max_iter=2000, tol=1e-13, fit_intercept=False).fit(X.numpy(), y.numpy())
    prior = replace(prior, group_scales=torch.tensor([1.0, peer.lambda_**-0.5]).double())
    regression = both_forms(X, y, prior)[form]
    root = regression.covariance_root(regression.solve(prior, (float(peer.alpha_) ** -0.5,))).as_matrix
    assert_close(root @ root.t(), torch.from_numpy(peer.sigma_), rtol=1e-9)


@pytest.mark.parametrize("form", ["primal", "dual"])
def test_the_evidence_is_that_of_a_gaussian_process(form: str):
    X, y, prior = random_case(values=12)
    size, noise = float(prior.group_scales[1]), 0.4
    kernel = ConstantKernel(size**2, "fixed") * DotProduct(0.0, "fixed")
    peer = GaussianProcessRegressor(kernel, alpha=noise**2, optimizer=None).fit(X.numpy(), y.numpy())
    posterior = both_forms(X, y, prior)[form].solve(prior, (noise,))
    constant = -0.5 * len(y) * math.log(2 * math.pi)
    assert posterior.log_evidence + constant == pytest.approx(peer.log_marginal_likelihood_value_, rel=1e-10)


@pytest.mark.parametrize("form", ["primal", "dual"])
@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_parameters_without_prior_are_exact_in_fifty_digits(form: str, scale: float):
    """Weights of a millionth of the parameters' size, like gear errors compared with lengths."""
    X, y, prior = random_case(values=14, parameters=3)
    X[:, 3:] *= scale
    prior = replace(prior, group_scales=prior.group_scales * torch.tensor([1.0, 1 / scale]).double())
    noise = 0.3
    regression = both_forms(X, y, prior)[form]
    posterior = regression.solve(prior, (noise,))
    root = regression.covariance_root(posterior).as_matrix
    with mpmath.workdps(50):
        A, b = mpmath.matrix(X.tolist()), mpmath.matrix(y.tolist())
        normal = A.T * A / mpmath.mpf(noise) ** 2 + mpmath.diag(prior.precision.tolist())
        x, covariance = mpmath.lu_solve(normal, A.T * b / mpmath.mpf(noise) ** 2), normal**-1
    exact = torch.tensor([float(one) for one in x], dtype=torch.float64)
    variances = torch.tensor([float(covariance[k, k]) for k in range(len(x))], dtype=torch.float64)
    assert_close(posterior.x, exact, rtol=1e-9)
    assert_close(root.square().sum(1), variances, rtol=1e-9)
