"""Bayesian linear regression by normal equations, for more values than unknowns."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.cholesky import (
    BLOCK,
    invert_triangle,
    log_determinant,
    release_free_memory,
    row_blocks,
    scaled_cholesky,
)
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import AbstractRegression, Posterior, SensorValueCount


@dataclass(frozen=True, eq=False)
class SolvedRegression:
    """Solution of normal equations with a prior: `D (Σ X^T X / noise² + precision) D = L L^T`.

    Attributes:
        prior: prior of the unknowns.
        noise: standard deviation for every sensor.
        scale: diagonal of D.
        inverse_factor: L^-1, lower triangular, so that the covariance is `D L^-T L^-1 D`.
        log_det: logarithm of the determinant of `Σ X^T X / noise² + precision`.
        x: most probable values.
    """

    prior: GaussianPrior
    noise: tuple[float, ...]
    scale: Float64[Tensor, " unknowns"]
    inverse_factor: Float64[Tensor, "unknowns unknowns"]
    log_det: float
    x: Float64[Tensor, " unknowns"]

    @property
    def variance(self) -> Float64[Tensor, " unknowns"]:
        """Variance of every unknown, the diagonal of the covariance."""
        deviation: Tensor = self.scale * torch.linalg.vector_norm(self.inverse_factor, dim=0)
        return deviation.square()

    def trace_of_product(self, matrix: Float64[Tensor, "unknowns unknowns"]) -> float:
        """Return the trace of a symmetric matrix times the covariance, which is computed block by block."""
        trace = 0.0
        for rows in row_blocks(len(self.x), BLOCK):
            block = (
                self.inverse_factor[rows.start :, rows].t() @ self.inverse_factor[rows.start :, : rows.stop]
            )
            scale = self.scale[: rows.stop].clone()
            scale[: rows.start].mul_(2)  # counts the blocks above the diagonal as well
            trace += float(self.scale[rows] @ (block.mul_(matrix[rows, : rows.stop]) @ scale))
        return trace


@dataclass(frozen=True, eq=False)
class PrimalRegression(AbstractRegression):
    """Normal equations of every sensor, not yet divided by its noise variance.

    Attributes:
        normal: `Σ X^T X` for every sensor, of weighted rows.
        descent: `Σ X^T y` for every sensor.
        squared_values: `Σ y^T y` for every sensor.
        sensors: number of values of every sensor.
        latest_solution: cache of the last solution, which evidence, held-out errors and covariance share.
    """

    normal: Float64[Tensor, "sensors unknowns unknowns"]
    descent: Float64[Tensor, "sensors unknowns"]
    squared_values: tuple[float, ...]
    sensors: tuple[SensorValueCount, ...]
    latest_solution: list[SolvedRegression] = field(default_factory=list, init=False)

    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """Solve `(Σ_s N_s / noise_s² + precision) x = Σ_s b_s / noise_s²` by Cholesky with column scaling."""
        precision = prior.precision
        solved = self.solved_with(prior, noise)
        x, held = solved.x, precision * solved.variance
        pairs = zip(self.normal[1:], noise[1:], strict=True)
        used = [solved.trace_of_product(N) / sigma**2 for N, sigma in pairs]
        # All sensors together determine what the prior does not, which saves computing the trace of the first sensor.
        used.insert(0, float((1 - held).sum()) - sum(used))
        misfit = self._misfits(x)
        log_prior = float(precision[precision > 0].log().sum())
        fit = sum(total / sigma**2 for total, sigma in zip(misfit, noise, strict=True))
        evidence = fit + float((x.square() * precision).sum()) + solved.log_det - log_prior
        evidence = -0.5 * (evidence + sum_log_noise_variance(self.sensors, noise))
        square, determined = (
            prior.sum_by_group(x.square() * prior.unit_precision),
            prior.sum_by_group(1 - held),
        )
        return Posterior(x, evidence, prior, noise, square, determined, misfit, tuple(used))

    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Return the covariance root of the unknowns: `D L^-T` with the names of `SolvedRegression`."""
        solved = self.solved_with(posterior.prior, posterior.noise)
        self.latest_solution.clear()
        return CovarianceRoot(solved.inverse_factor.t().mul_(solved.scale[:, None]))

    def solved_with(self, prior: GaussianPrior, noise: tuple[float, ...]) -> SolvedRegression:
        """Return the cached solution if prior and noise are unchanged, otherwise a new solution."""

        def normal() -> Tensor:
            torch.mul(self.normal[0], noise[0] ** -2, out=memory)
            for N, sigma in zip(self.normal[1:], noise[1:], strict=True):
                memory.add_(N, alpha=sigma**-2)
            memory.diagonal().add_(prior.precision)
            return memory

        if (
            not self.latest_solution
            or self.latest_solution[0].prior is not prior
            or self.latest_solution[0].noise != noise
        ):
            release_free_memory(len(prior.unit_precision))
            # The matrix may take gigabytes, so the memory of the previous factor is reused.
            memory = (
                self.latest_solution.pop().inverse_factor.mT
                if self.latest_solution
                else torch.empty_like(self.normal[0])
            )
            descent = torch.zeros_like(self.descent[0])
            for b, sigma in zip(self.descent, noise, strict=True):
                descent.add_(b, alpha=sigma**-2)
            scale, factor = scaled_cholesky(normal)
            log_det = log_determinant(scale, factor)
            inner = torch.linalg.solve_triangular(factor, (scale * descent)[:, None], upper=False)
            x = scale * torch.linalg.solve_triangular(factor.mT, inner, upper=True)[:, 0]
            invert_triangle(factor)
            self.latest_solution.append(SolvedRegression(prior, noise, scale, factor, log_det, x))
        return self.latest_solution[0]

    def _misfits(self, x: Float64[Tensor, " unknowns"]) -> tuple[float, ...]:
        """Return `Σ (y - X x)²` for every sensor."""
        cross = (self.descent @ x).tolist()
        inner = [float(x @ (N @ x)) for N in self.normal]
        return tuple(
            max(total - 2 * a + b, 0.0) for total, a, b in zip(self.squared_values, cross, inner, strict=True)
        )


def sum_log_noise_variance(sensors: Sequence[SensorValueCount], noise: Sequence[float]) -> float:
    """Return `Σ log noise²` over all values."""
    pairs = zip(sensors, noise, strict=True)
    return sum(2 * sensor.values * math.log(sigma) for sensor, sigma in pairs)
