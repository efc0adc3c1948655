"""Independent normal distributions conditioned on linear equations between their unknowns."""

from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True, eq=False)
class ConditionedUnknowns:
    """Unknowns z with a standard normal prior and x without a prior, given `B z + G x + e = r`.

    Attributes:
        z: most probable z.
        x: most probable x.
        z_root: root of the covariance of z, in the directions (z, e) of the prior.
        x_root: root of the covariance of x, in the same directions.
        misfit: `|z|² + |e|²` at the solution, which has a chi-squared distribution.
        redundancy: degrees of freedom of the misfit, the number of equations that x does not absorb.
    """

    z: Float64[Tensor, " directions"]
    x: Float64[Tensor, " unknowns"]
    z_root: Float64[Tensor, "directions prior"]
    x_root: Float64[Tensor, "unknowns prior"]
    misfit: float
    redundancy: int


def condition_on_equalities(
    B: Float64[Tensor, "equations directions"],
    G: Float64[Tensor, "equations unknowns"],
    r: Float64[Tensor, " equations"],
    closure: Float64[Tensor, " equations"],
) -> ConditionedUnknowns:
    """Condition a standard normal z on `B z + G x + e = r`: least squares for x with the covariance of the equations.

    With `C = B B^T + E²` and `M = (G^T C^-1 G)^-1 G^T C^-1`, `x = M r` and `z = B^T C^-1 (r - G x)` (Koch 1999,
    Parameter Estimation and Hypothesis Testing in Linear Models, section 3.5). x then has the covariance
    `(G^T C^-1 G)^-1`.

    Args:
        B: derivatives of the equations with respect to z.
        G: derivatives with respect to x, of full column rank.
        r: misclosure of the equations at z = 0 and x = 0.
        closure: standard deviation > 0 of e, with which the equations hold. It also keeps C positive definite if the
            prior of the values on both sides is exact.
    """
    E = closure.diag()
    along = torch.cat([B, E], 1)
    # QR of the transposed root instead of the Cholesky factor of C, which has the square of its condition number.
    half = torch.linalg.qr(along.mT, mode="r").R
    whiten = torch.linalg.solve_triangular(half.mT, torch.cat([G, r[:, None], along], 1), upper=False)
    count = G.shape[1]
    G_white, r_white, along_white = whiten[:, :count], whiten[:, count], whiten[:, count + 1 :]
    Q, R = torch.linalg.qr(G_white)
    x_root = torch.linalg.solve_triangular(R, Q.mT @ along_white, upper=True)
    x = torch.linalg.solve_triangular(R, (Q.mT @ r_white)[:, None], upper=True)[:, 0]
    missed = r_white - Q @ (Q.mT @ r_white)
    # Projection onto the directions that the redundant equations determine.
    seen = along_white - Q @ (Q.mT @ along_white)
    size = B.shape[1]
    z_root = torch.eye(along.shape[1]).to(B)[:size] - along_white[:, :size].mT @ seen
    return ConditionedUnknowns(
        along_white[:, :size].mT @ missed, x, z_root, -x_root, float(missed.square().sum()), len(r) - count
    )
