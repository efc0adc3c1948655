"""Cholesky factors of symmetric matrices, operations on them that need little memory, and orthonormal bases."""

import ctypes
import sys
from collections.abc import Callable

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import IdentificationError

BLOCK = 192
"""Block size of operations on triangular matrices: small blocks multiply fewer zeros, large ones are faster."""
_MANY_UNKNOWNS = 1_000
"""Number of unknowns above which free memory is returned before a matrix is allocated."""


def scaled_cholesky(matrix: Callable[[], Float64[Tensor, "unknowns unknowns"]]) -> tuple[Tensor, Tensor]:
    """Return the column scale D and the Cholesky factor L of a symmetric matrix M, with `D M D = L L^T`.

    Args:
        matrix: function that returns the matrix, row-major; its upper triangle is read. The factor overwrites it, so
            it is called again if the factorisation fails.

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
                "the normal equations are not finite",
                expected="finite measurements",
                remedy="check the measurements for infinite or huge values",
            )
        jitter *= 10


def covariance_cholesky(V: Float64[Tensor, "values values"]) -> Float64[Tensor, "values values"]:
    """Return the Cholesky factor of a covariance of values, with jitter if rounding makes it indefinite."""
    jitter = 0.0
    while True:
        factor: Tensor
        factor, failed = torch.linalg.cholesky_ex(V + jitter * V.diagonal().diag())
        if not failed:
            return factor
        jitter = max(10 * jitter, 1e-14)


def log_determinant(scale: Tensor, factor: Tensor) -> float:
    """Return the natural logarithm of the determinant of a matrix from its column scale and Cholesky factor."""
    return 2 * float(factor.diagonal().log().sum()) - 2 * float(scale.log().sum())


def invert_from_factor(scale: Tensor, factor: Tensor) -> Float64[Tensor, "unknowns unknowns"]:
    """Return the inverse of a matrix from its column scale and Cholesky factor, whose memory it overwrites."""
    inverse: Tensor = torch.cholesky_inverse(factor, out=factor).mT  # symmetric, so this is row-major
    return inverse.mul_(scale).mul_(scale[:, None])


def invert_triangle(factor: Tensor) -> None:
    """Invert a lower triangular matrix in place, block by block, so that most of the work is matrix products."""
    stretches = row_blocks(len(factor), BLOCK)
    for number, rows in enumerate(stretches):
        diagonal = factor[rows, rows]
        identity = torch.eye(len(diagonal), dtype=factor.dtype, device=factor.device)
        inverse = torch.linalg.solve_triangular(diagonal, identity, upper=False)
        before = factor[rows, : rows.start].clone()
        for columns in stretches[:number]:
            inner = factor[columns.start : rows.start, columns]
            factor[rows, columns] = -inverse @ (before[:, columns.start :] @ inner)
        diagonal.copy_(inverse)


def row_blocks(count: int, size: int) -> list[slice]:
    """Return slices that divide `count` rows into blocks of `size` rows."""
    return [slice(start, start + size) for start in range(0, count, size)]


def release_free_memory(unknowns: int) -> None:
    """Return free memory to the system after fits of many unknowns, if the C library can (`malloc_trim` of glibc).

    After a fit of thousands of unknowns, more than 100 MB of free memory is fragmented, and the matrices of the next
    fit would be allocated in addition to this memory.
    """
    if unknowns > _MANY_UNKNOWNS and sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)


TOLERANCE = 1e-9
"""Ratio of a singular value to the largest one, of columns of unit length, below which it is zero up to rounding."""


def orthonormal_columns(A: Float64[Tensor, "rows columns"]) -> Float64[Tensor, "rows _rank"]:
    """Return an orthonormal basis of the column space, which does not depend on the units of the columns."""
    U, singular, _ = torch.linalg.svd(A / A.norm(dim=0).clamp(min=1e-300), full_matrices=False)
    basis: Tensor = U[:, singular > TOLERANCE * singular.max()] if A.numel() else U
    return basis
