"""Orthonormal basis of the space that the columns of a matrix span."""

import torch
from jaxtyping import Float64
from torch import Tensor

TOLERANCE = 1e-9
"""Ratio of a singular value to the largest one, of columns of unit length, below which it is zero up to rounding."""


def orthonormal_columns(A: Float64[Tensor, "rows columns"]) -> Float64[Tensor, "rows _rank"]:
    """Return an orthonormal basis of the column space, which does not depend on the units of the columns."""
    U, singular, _ = torch.linalg.svd(A / A.norm(dim=0).clamp(min=1e-300), full_matrices=False)
    basis: Tensor = U[:, singular > TOLERANCE * singular.max()] if A.numel() else U
    return basis
