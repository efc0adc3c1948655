"""Update of the posterior of all unknowns by new values, as a covariance root."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.cholesky import factored
from pisigma.estimation.drift import Drift, LinearValues

MAX_DIRECTIONS = 1.2
"""Largest number of directions of a root, relative to the number of unknowns."""


class PosteriorUpdate:
    """Kalman's update of a root R of a covariance: with A = X R / noise, `R (I + A^T A)^-1/2` is that of the posterior.

    It is computed from the eigenvalues of `A A^T` for few values, else from the Cholesky factor of `I + A^T A`.
    Source: Bierman 1977, Factorization Methods for Discrete Sequential Estimation, chapter II.

    Attributes:
        shift: most probable change of the unknowns.
        effective: number of directions that the values determine.
    """

    def __init__(
        self, root: Float64[Tensor, "unknowns directions"], values: LinearValues, drift: Drift
    ) -> None:
        """Update the covariance `root root^T` plus that of the drift.

        Args:
            root: covariance root before the values.
            values: new values.
            drift: drift since then, and noise of the values.
        """
        self._root = root
        drifted = [group for group in drift.groups if group.size > 0]
        index = torch.cat([group.index for group in drifted] or [torch.zeros(0, dtype=torch.int64)])
        deviation = torch.cat([group.deviation for group in drifted] or [values.y[:0]])
        self._index, self._deviation = index, deviation
        noise = values.deviation(drift.noise)
        A = torch.cat([values.X @ root, values.X[:, index] * deviation], 1) / noise[:, None]
        y = values.y / noise
        self._few = 2 * len(y) <= A.shape[1]
        if self._few:
            self._eigenvalues, U = torch.linalg.eigh(A @ A.t())
            self._eigenvalues = self._eigenvalues.clamp(min=0.0)
            self._along = A.t() @ U
            z = self._along @ ((U.t() @ y) / (1 + self._eigenvalues))
            self.effective = float((self._eigenvalues / (1 + self._eigenvalues)).sum())
        else:
            M = A.t() @ A
            M.diagonal().add_(1.0)
            self._L = torch.linalg.cholesky(M)
            z = torch.cholesky_solve((A.t() @ y)[:, None], self._L)[:, 0]
            self.effective = len(M) - float(torch.cholesky_inverse(self._L).trace())
        directions = root.shape[1]
        self.shift = root @ z[:directions]
        self.shift.index_add_(0, index, deviation * z[directions:])

    def root(self) -> Float64[Tensor, "unknowns directions"]:
        """Return the covariance root of the posterior, with at most `MAX_DIRECTIONS` columns per unknown."""
        extra = torch.zeros(len(self._root), len(self._index), dtype=torch.float64)
        extra[self._index, torch.arange(len(self._index))] = self._deviation
        R = torch.cat([self._root, extra], 1)
        if not self._few:
            root: Tensor = torch.linalg.solve_triangular(self._L, R.t(), upper=False).t()
        else:
            # 1 / sqrt(t) - 1 over t - 1 with t = 1 + eigenvalue, without cancellation
            t = 1 + self._eigenvalues
            shrink = -1 / (t.sqrt() * (1 + t.sqrt()))
            root = R.addmm_((R @ self._along) * shrink, self._along.t())
        if root.shape[1] <= MAX_DIRECTIONS * len(root):
            return root
        scale, factor = factored(lambda: root @ root.t())
        return torch.where(root.any(1)[:, None], factor / scale[:, None], 0.0)
