"""Cholesky factors of symmetric matrices, and what is made of them in little memory."""

import ctypes
import sys
from collections.abc import Callable

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError

BLOCK = 192
"""Triangular matrices are worked on in blocks of so many rows: small ones leave less of what is 0 in the products,
large ones are multiplied faster."""
MANY_UNKNOWNS = 1_000
"""Matrices of more are large enough to make room for."""


def factored(matrix: Callable[[], Float64[Tensor, "unknowns unknowns"]]) -> tuple[Tensor, Tensor]:
    """Column scale, and Cholesky factor of a scaled symmetric matrix.

    Args:
        matrix: makes it, stored row by row; its upper triangle is read. As the factor takes its memory, it is made
            again where that fails.

    Raises:
        IdentificationError: the matrix is not finite.
    """
    jitter = 1e-14
    while True:
        scaled = matrix()
        scale = scaled.diagonal().clamp(min=1e-300).rsqrt()
        scaled.mul_(scale).mul_(scale[:, None]).diagonal().fill_(1 + jitter)
        by_column, status = scaled.mT, torch.empty((), dtype=torch.int32, device=scaled.device)
        factor, failed = torch.linalg.cholesky_ex(by_column, out=(by_column, status))
        if not failed:
            return scale, factor
        if not bool(torch.isfinite(matrix()).all()):
            raise IdentificationError(
                "the normal equations are not finite; look for values without limit in the measurements."
            )
        jitter *= 10


def covariance_factor(V: Float64[Tensor, "values values"]) -> Float64[Tensor, "values values"]:
    """Cholesky factor of a covariance of values; rounding of far larger variances is made up for."""
    jitter = 0.0
    while True:
        factor: Tensor
        factor, failed = torch.linalg.cholesky_ex(V + jitter * V.diagonal().diag())
        if not failed:
            return factor
        jitter = max(10 * jitter, 1e-14)


def log_determinant(scale: Tensor, factor: Tensor) -> float:
    """Of a matrix from what `factored` gives."""
    return 2 * float(factor.diagonal().log().sum()) - 2 * float(scale.log().sum())


def inverted(scale: Tensor, factor: Tensor) -> Float64[Tensor, "unknowns unknowns"]:
    """Inverse of a matrix from what `factored` gives, in the place of the factor."""
    inverse: Tensor = torch.cholesky_inverse(factor, out=factor).mT  # symmetric, and so stored row by row
    return inverse.mul_(scale).mul_(scale[:, None])


def invert_triangle(factor: Tensor) -> None:
    """Put its inverse in the place of a lower triangular matrix: block by block, so that most of it are products."""
    stretches = blocks(len(factor), BLOCK)
    for number, rows in enumerate(stretches):
        diagonal = factor[rows, rows]
        identity = torch.eye(len(diagonal), dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(diagonal, identity, upper=False)
        before = factor[rows, : rows.start].clone()
        for columns in stretches[:number]:
            inner = factor[columns.start : rows.start, columns]
            factor[rows, columns] = -inverse @ (before[:, columns.start :] @ inner)
        diagonal.copy_(inverse)


def blocks(count: int, size: int) -> list[slice]:
    """Rows that are worked on together."""
    return [slice(start, start + size) for start in range(0, count, size)]


def return_free_memory(unknowns: int) -> None:
    """Give free memory back to the system where the C library offers that (`malloc_trim` of glibc); else do nothing.

    After fits of thousands of unknowns more than 100 MB are free in pieces between what is in use, and the matrices of
    the next fit would come on top of them.
    """
    if unknowns > MANY_UNKNOWNS and sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
