"""Damped Newton steps for few poses at once, by products of matrices; see `MovingArm.approach`."""

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.kinematics.matrix_chain import MatrixChain


class DampedSteps:
    """Steps of one arm, some thirty operations each, whatever the number of poses."""

    def __init__(self, chain: MatrixChain, length: float) -> None:
        """Take the arm, and the length that lengths are divided by [m]."""
        self._chain = chain
        self._scale = torch.tensor([1 / length] * 3 + [1.0] * 3, dtype=torch.float64)

    def take(
        self,
        wanted: Float64[Tensor, "poses 3 4"],
        q: Float64[Tensor, "poses dof"],
        factor: Float64[Tensor, " poses"],
        steps: int,
    ) -> tuple[Float64[Tensor, "poses dof"], Float64[Tensor, " poses"], Float64[Tensor, " poses"]]:
        """Joint values after some steps, squared residuals there, and factors of the damping.

        Steps are `Aᵀ (A Aᵀ + λ)⁻¹ e` with λ the factor times the squared residual; those that lead away are not made
        and damped eightfold, others five times less.
        """
        A, error = self._look(wanted, q)
        square = error.square().sum(-1)
        for _ in range(steps):
            G = A @ A.mT
            G.diagonal(dim1=-2, dim2=-1).add_((factor * square + 1e-15)[:, None])
            y = torch.cholesky_solve(error[..., None], torch.linalg.cholesky_ex(G)[0])
            trial = q + (A.mT @ y)[..., 0]
            A_trial, error_trial = self._look(wanted, trial)
            left = error_trial.square().sum(-1)
            better = left < square
            row = better[:, None]
            q, square = torch.where(row, trial, q), torch.where(better, left, square)
            error, A = torch.where(row, error_trial, error), torch.where(row[..., None], A_trial, A)
            factor = (factor * torch.where(better, 0.2, 8.0)).clamp(min=1e-6)
        return q, square, factor

    def _look(self, wanted: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """Jacobian `(poses, 6, dof)` and what is left to the poses `(poses, 6)`, lengths divided by the length."""
        T, J = self._chain.motion(q)
        between = wanted[..., :3] @ T[:, :3, :3].mT  # its skew part is axis times sine of the angle
        skew = between - between.mT
        turn = 0.5 * torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
        trace = between.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        sine = turn.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        turn = torch.where(trace < 1, turn * ((2 - sine) / sine), turn)
        error = torch.cat([wanted[..., 3] - T[:, :3, 3], turn], -1)
        return J * self._scale[:, None], error * self._scale
