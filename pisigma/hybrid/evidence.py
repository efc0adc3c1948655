"""Bayesian linear least squares: the posterior, and prior sizes and noise by the evidence."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import IdentificationError
from pisigma.identification.problem.noise import LEAST_EFFECTIVE, SMALLEST_NOISE, SMALLEST_PRIOR

SMALLEST_SIZE = 1e-9
"""Prior size [rad] below which a group of weights is off."""
FIRST_SIZE = 2e-5
"""Prior size [rad] that weights start with."""


@dataclass(frozen=True, eq=False)
class Sums:
    """Normal equations of every sensor, before division by its noise's variance.

    Attributes:
        normal: `Σ X^T X` per sensor, rows already weighted.
        descent: `Σ X^T y`.
        square: `Σ y^T y`.
        count: number of values that count as independent.
        stated: per sensor whether its rows state their noise, which then is at least as large.
        exact: per sensor whether it is exactly as stated.
    """

    normal: Float64[Tensor, "sensors unknowns unknowns"]
    descent: Float64[Tensor, "sensors unknowns"]
    square: tuple[float, ...]
    count: tuple[float, ...]
    stated: tuple[bool, ...]
    exact: tuple[bool, ...]

    def select(self, columns: Int64[Tensor, " chosen"]) -> "Sums":
        """The same for some of the unknowns."""
        normal = self.normal[:, columns][:, :, columns]
        return replace(self, normal=normal, descent=self.descent[:, columns])

    def minus(self, other: "Sums") -> "Sums":
        """Without the rows of another."""
        return replace(
            self,
            normal=self.normal - other.normal,
            descent=self.descent - other.descent,
            square=tuple(a - b for a, b in zip(self.square, other.square, strict=True)),
            count=tuple(a - b for a, b in zip(self.count, other.count, strict=True)),
        )


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Independent normal unknowns: precision `base / sizes[group]²`.

    Attributes:
        base: 1 / variance at size 1; 0 where there is no prior knowledge.
        group: number of every unknown's size.
        sizes: standard deviations.
        classes: the first so many groups are classes of geometric parameters, whose sizes are factors on what
            was stated; they move only within limits.
        fixed: whether the sizes of these classes stand.
        standing: other groups whose sizes stand.
    """

    base: Float64[Tensor, " unknowns"]
    group: Int64[Tensor, " unknowns"]
    sizes: Float64[Tensor, " groups"]
    classes: int
    fixed: bool = False
    standing: tuple[int, ...] = ()

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """1 / variance."""
        return self.base / self.sizes[self.group].square()

    def select(self, columns: Int64[Tensor, " chosen"]) -> "GaussianPrior":
        """Of some of the unknowns."""
        return replace(self, base=self.base[columns], group=self.group[columns])

    def updated(
        self, x: Float64[Tensor, " unknowns"], variance: Float64[Tensor, " unknowns"]
    ) -> "GaussianPrior":
        """Sizes by MacKay's rule (1992, Neural Computation 4(3), eq. 4.7), `size² = Σ x² base / Σ determined`."""
        determined = (1 - self.precision * variance) * (self.base > 0)
        count = torch.zeros_like(self.sizes).index_add(0, self.group, determined)
        square = torch.zeros_like(self.sizes).index_add(0, self.group, x.square() * self.base)
        is_class = torch.arange(len(self.sizes), device=x.device) < self.classes
        least = torch.where(is_class, LEAST_EFFECTIVE, 1e-9)
        floor = torch.where(is_class, SMALLEST_PRIOR, SMALLEST_SIZE)
        sizes = torch.maximum((square / count.clamp(min=1e-12)).sqrt(), floor)
        stands = (count <= least) | (is_class & self.fixed)
        stands[list(self.standing)] = True
        return replace(self, sizes=torch.where(stands, self.sizes, sizes))


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the data say of the unknowns.

    Attributes:
        x: most probable values.
        covariance: of the unknowns; empty where it was not asked for.
        log_evidence: of the data under the prior, up to a constant of the data.
        prior: with its sizes as estimated.
        noise: standard deviation per sensor [m or rad], or a factor on the stated ones.
        iterations: updates made.
    """

    x: Float64[Tensor, " unknowns"]
    covariance: Float64[Tensor, "uncertain uncertain"]
    log_evidence: float
    prior: GaussianPrior
    noise: tuple[float, ...]
    iterations: int

    @property
    def determined(self) -> Float64[Tensor, " unknowns"]:
        """Share of every unknown that the data determine, from 0 to 1; the prior holds the rest."""
        return 1 - self.prior.precision * self.covariance.diagonal()


def effective_share(sums: Sums, posterior: Posterior) -> float:
    """Share of the values that the unknowns use up; near 1 nothing is left that tells noise from error."""
    values = sum(count for count, exact in zip(sums.count, sums.exact, strict=True) if not exact)
    return float(posterior.determined.sum()) / max(values, 1.0)


def solve_posterior(sums: Sums, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
    """Solve `(Σ_s N_s / noise_s² + precision) x = Σ_s b_s / noise_s²` by Cholesky with column scaling.

    The log evidence is that of MacKay 1992, eq. (4.9), for several sensors.
    """
    precision = prior.precision
    x, scale, factor = _solved(sums, prior, noise)
    covariance = torch.cholesky_inverse(factor) * scale * scale[:, None]
    log_det = 2 * float(factor.diagonal().log().sum()) - 2 * float(scale.log().sum())
    log_prior = float(precision[precision > 0].log().sum())
    fit = sum(misfit / sigma**2 for misfit, sigma in zip(misfits(sums, x), noise, strict=True))
    spread = sum(2 * count * math.log(sigma) for count, sigma in zip(sums.count, noise, strict=True))
    evidence = -0.5 * (fit + float((x.square() * precision).sum()) + spread + log_det - log_prior)
    return Posterior(x, covariance, evidence, prior, noise, 0)


def solve_mean(sums: Sums, prior: GaussianPrior, noise: tuple[float, ...]) -> Float64[Tensor, " unknowns"]:
    """Most probable values alone, without covariance and evidence; see `solve_posterior`."""
    return _solved(sums, prior, noise)[0]


def _solved(sums: Sums, prior: GaussianPrior, noise: tuple[float, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Most probable values, and column scale and Cholesky factor of the matrix that they solve."""
    weight = prior.base.new_tensor([sigma**-2 for sigma in noise])
    normal = torch.einsum("s,sij->ij", weight, sums.normal)
    normal.diagonal().add_(prior.precision)
    scale, factor = _factored(normal)
    descent = weight @ sums.descent
    return scale * torch.cholesky_solve((scale * descent)[:, None], factor)[:, 0], scale, factor


def _factored(normal: Float64[Tensor, "unknowns unknowns"]) -> tuple[Tensor, Tensor]:
    """Column scale, and Cholesky factor of the scaled matrix.

    Raises:
        IdentificationError: the matrix is not finite.
    """
    scale = normal.diagonal().clamp(min=1e-300).rsqrt()
    scaled = normal * scale * scale[:, None]
    jitter = 1e-14
    while True:
        scaled.diagonal().fill_(1 + jitter)
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not failed:
            return scale, factor
        if not bool(torch.isfinite(scaled).all()):
            raise IdentificationError(
                "the normal equations are not finite; look for values without limit in the measurements."
            )
        jitter *= 10


def misfits(sums: Sums, x: Float64[Tensor, " unknowns"]) -> tuple[float, ...]:
    """`Σ (y - X x)²` per sensor."""
    cross = (sums.descent @ x).tolist()
    inner = ((sums.normal @ x) @ x).tolist()
    return tuple(max(square - 2 * a + b, 0.0) for square, a, b in zip(sums.square, cross, inner, strict=True))


def maximise_evidence(
    sums: Sums, prior: GaussianPrior, noise: tuple[float, ...], iterations: int = 40, tolerance: float = 5e-2
) -> Posterior:
    """Estimate prior sizes and noise together with the unknowns.

    Args:
        sums: normal equations.
        prior: with sizes to start from.
        noise: to start from.
        iterations: updates at most.
        tolerance: the search ends when the log evidence rises by less.

    Returns:
        The posterior of the last update.
    """
    posterior = solve_posterior(sums, prior, noise)
    for made in range(1, iterations + 1):
        prior = posterior.prior.updated(posterior.x, posterior.covariance.diagonal())
        noise = renewed_noise(sums, posterior)
        following = replace(solve_posterior(sums, prior, noise), iterations=made)
        gain = following.log_evidence - posterior.log_evidence
        posterior = following
        if abs(gain) < tolerance:
            break
    return posterior


def renewed_noise(sums: Sums, posterior: Posterior) -> tuple[float, ...]:
    """Noise of every sensor from its misfit and the values that the unknowns use up (Förstner 1979)."""
    used = (sums.normal * posterior.covariance).sum((1, 2)).tolist()
    noise = []
    for k, misfit in enumerate(misfits(sums, posterior.x)):
        left = max(sums.count[k] - used[k] / posterior.noise[k] ** 2, 1.0)
        sigma = 1.0 if sums.exact[k] else math.sqrt(misfit / left)
        noise.append(max(sigma, 1.0 if sums.stated[k] else SMALLEST_NOISE))
    return tuple(noise)
