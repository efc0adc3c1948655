"""A covariance root in factors agrees with the matrix."""

import torch
from testing.closeness import assert_close
from torch import Tensor

from pisigma.estimation.covariance_root import CovarianceRoot, ImplicitCovarianceRoot

PARAMETERS, WEIGHTS, VALUES = 3, 12, 5


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def factored() -> CovarianceRoot:
    Z, size = normal(VALUES, WEIGHTS, seed=1), normal(WEIGHTS, seed=2).abs() + 0.1
    factor = torch.linalg.cholesky(Z @ Z.t() + torch.eye(VALUES, dtype=torch.float64))
    return CovarianceRoot(normal(PARAMETERS + WEIGHTS, 4, seed=3), ImplicitCovarianceRoot(size, Z, factor))


def test_the_covariance_after_few_values_is_the_inverse_of_the_information() -> None:
    few = factored().weights
    assert few is not None
    root = few.left_multiply(torch.eye(WEIGHTS, dtype=torch.float64))
    precision = few.Z.t() @ few.Z + torch.eye(WEIGHTS, dtype=torch.float64)
    expected = few.prior_sigma[:, None] * torch.linalg.inv(precision) * few.prior_sigma
    assert_close(root @ root.t(), expected, rtol=1e-12)


def test_products_are_those_of_the_matrix() -> None:
    root = factored()
    columns, matrix = normal(2, 3, PARAMETERS + WEIGHTS, seed=4), normal(PARAMETERS + WEIGHTS, 2, seed=5)
    assert_close(root.left_multiply(columns), columns @ root.as_matrix, rtol=1e-12)
    assert_close(root.covariance_times(matrix), root.as_matrix @ root.as_matrix.t() @ matrix, rtol=1e-12)
    dense = CovarianceRoot(root.as_matrix)
    assert_close(dense.left_multiply(columns), columns @ root.as_matrix, rtol=1e-12)
    assert_close(dense.covariance_times(matrix), root.as_matrix @ root.as_matrix.t() @ matrix, rtol=1e-12)


def test_extended_by_columns_scale_and_coordinates() -> None:
    root, added, change = factored(), normal(PARAMETERS + WEIGHTS, 2, seed=6), normal(6, PARAMETERS, seed=7)
    extended = root.with_columns(added, 3.0, change)
    whole = torch.block_diag(change, torch.eye(WEIGHTS, dtype=torch.float64))
    C = whole @ (root.as_matrix @ root.as_matrix.t() + added @ added.t()) @ whole.t() * 9.0
    assert_close(extended.as_matrix @ extended.as_matrix.t(), C, rtol=1e-12)
