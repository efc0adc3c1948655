"""Conditioning on equations: what dense normal equations with a large weight of the equations give."""

import torch
from testing.closeness import assert_close

from pisigma.estimation.covariance_root import condition_on_equalities


def test_solution_and_covariance_are_those_of_weighted_least_squares():
    generator = torch.Generator().manual_seed(0)
    B, G = (torch.randn(9, count, generator=generator, dtype=torch.float64) for count in (12, 4))
    r = torch.randn(9, generator=generator, dtype=torch.float64)
    closure = torch.full((9,), 0.1, dtype=torch.float64)
    found = condition_on_equalities(B, G, r, closure)
    X = torch.cat(
        [torch.cat([torch.eye(12).double(), torch.zeros(12, 4).double()], 1), torch.cat([B, G], 1) / 0.1]
    )
    y = torch.cat([torch.zeros(12).double(), r / 0.1])
    covariance = torch.linalg.inv(X.mT @ X)
    solution = covariance @ X.mT @ y
    root = torch.cat([found.z_root, found.x_root])
    assert_close(torch.cat([found.z, found.x]), solution, atol=1e-10)
    assert_close(root @ root.mT, covariance, atol=1e-10)
    assert_close(found.misfit, float((y - X @ solution).square().sum()), rtol=1e-9)
    assert found.degrees_of_freedom == 5


def test_equations_between_exact_values_hold():
    B, G = torch.zeros(6, 3).double(), torch.eye(3).double().repeat(2, 1)
    found = condition_on_equalities(B, G, torch.ones(6).double(), torch.full((6,), 1e-9, dtype=torch.float64))
    assert_close(found.x, torch.ones(3), atol=1e-12)
    assert_close(found.x_root.norm(dim=1), 1e-9 / 2**0.5, rtol=1e-9)
