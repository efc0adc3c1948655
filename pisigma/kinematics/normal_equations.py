"""Square linear systems written out on components: one system a pose, every entry a vector over the poses.

LAPACK solves a stack of 6x6 systems one by one, at some microseconds each; written out, a step costs a tenth of that,
but takes several hundred operations, so that few systems are left to LAPACK.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

FEW = 192
"""Fewer systems than this are left to LAPACK."""


@dataclass(frozen=True, eq=False)
class NormalSolution:
    """What `solve_normal` gives.

    Attributes:
        step: the unknowns, one vector over the poses each.
        determinant: `|det A|`.
        trace: `trace(A Aᵀ)`, the sum of the squared singular values.
    """

    step: list[Float[Tensor, " poses"]]
    determinant: Float[Tensor, " poses"]
    trace: Float[Tensor, " poses"]

    def least_singular_value(self) -> Float[Tensor, " poses"]:
        """A bound from below on the smallest singular value of A, 0 where A is singular.

        The product of the other n - 1 is at most `(trace / (n - 1)) ** ((n - 1) / 2)`, by the means.
        """
        others = len(self.step) - 1
        return self.determinant / (self.trace / others) ** (others / 2)


def solve_normal(
    A: Sequence[Sequence[Tensor]], e: Sequence[Tensor], damping: Tensor | None = None
) -> NormalSolution:
    """Solve `A x = e` as `x = Aᵀ (A Aᵀ + λ)⁻¹ e`, by `L D Lᵀ` without pivoting, which a positive matrix allows.

    Args:
        A: n rows of n entries, each `(poses,)`.
        e: n entries, each `(poses,)`.
        damping: λ `(poses,)`, or None for 0.

    Returns:
        The solution; where A is singular and nothing damps it its numbers are no solution, or not finite. The
        determinant is that of the damped system.
    """
    n = len(e)
    if e[0].shape[0] < FEW:
        return _solve_few(A, e, damping)
    G = [[dot(A[i], A[j]) for j in range(i + 1)] for i in range(n)]
    if damping is not None:
        for i in range(n):
            G[i][i] += damping
    L, D = _factorise(G)
    y = list(e)
    for i in range(n):
        for j in range(i):
            y[i] = torch.addcmul(y[i], L[i][j], y[j], value=-1)
    y = [value / pivot for value, pivot in zip(y, D, strict=True)]
    for i in reversed(range(n)):
        for j in range(i + 1, n):
            y[i].addcmul_(L[j][i], y[j], value=-1)
    step = [dot([row[k] for row in A], y) for k in range(n)]
    square, trace = D[0].clone(), torch.zeros_like(D[0])
    for pivot in D[1:]:
        square *= pivot
    for row in A:
        trace = trace + dot(row, row)
    return NormalSolution(step, square.clamp(min=0).sqrt(), trace)


def _solve_few(A: Sequence[Sequence[Tensor]], e: Sequence[Tensor], damping: Tensor | None) -> NormalSolution:
    """The same by few operations on all of a system."""
    rows = torch.stack([value for row in A for value in row], -1).reshape(-1, len(e), len(e))
    G = rows @ rows.mT
    trace = G.diagonal(dim1=-2, dim2=-1).sum(-1)
    if damping is not None:
        G.diagonal(dim1=-2, dim2=-1).add_(damping[:, None])
    L, _ = torch.linalg.cholesky_ex(G)
    step = rows.mT @ torch.cholesky_solve(torch.stack(list(e), -1)[..., None], L)
    determinant: Tensor = L.diagonal(dim1=-2, dim2=-1).prod(-1)
    return NormalSolution(list(step[..., 0].unbind(-1)), determinant, trace)


def _factorise(G: list[list[Tensor]]) -> tuple[list[list[Tensor]], list[Tensor]]:
    """L below the diagonal and D of the lower triangle `G = L D Lᵀ`, which is overwritten."""
    L: list[list[Tensor]] = []
    D: list[Tensor] = []
    for i, row in enumerate(G):
        for j in range(i):
            for k in range(j):
                row[j].addcmul_(row[k], L[j][k], value=-1)
        factors = [row[j] / D[j] for j in range(i)]
        for j in range(i):
            row[i].addcmul_(row[j], factors[j], value=-1)
        L.append(factors)
        D.append(row[i])
    return L, D


def dot(u: Sequence[Tensor], v: Sequence[Tensor]) -> Tensor:
    """`Σ u_i v_i`."""
    total: Tensor = u[0] * v[0]
    for a, b in zip(u[1:], v[1:], strict=True):
        total.addcmul_(a, b)
    return total
