"""Covariance of the solution of a least-squares problem."""

import torch
from jaxtyping import Float64
from torch import Tensor


def covariance_of(normal: Float64[Tensor, "active active"]) -> Float64[Tensor, "active active"]:
    """Inverse of a normal matrix, with column scaling; directions that it does not hold get no variance."""
    diagonal = normal.diagonal()
    scale = torch.where(diagonal > 0, diagonal, 1.0).rsqrt()
    scales = scale * scale[:, None]
    scaled = normal * scales
    factor, failed = torch.linalg.cholesky_ex(scaled)
    if not failed and float(factor.diagonal().min()) > 1e-6:
        inverse = torch.cholesky_inverse(factor)
    else:
        inverse = torch.linalg.pinv(scaled, rtol=1e-12, hermitian=True)
    return inverse * scales
