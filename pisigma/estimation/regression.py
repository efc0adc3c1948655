"""Bayesian linear regression: the posterior, and prior sizes and noise by the evidence."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.prior import GaussianPrior

SMALLEST_NOISE = 1e-8
"""[m or rad] Floor of the estimated noise: far below what instruments resolve."""
LEAST_EFFECTIVE = 0.5
"""Prior sizes of groups of which the data determine fewer unknowns do not matter."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the data say of the unknowns.

    Attributes:
        x: most probable values.
        log_evidence: of the data under the prior, up to a constant of the data.
        prior: with its sizes as estimated.
        noise: standard deviation per sensor [m or rad], or a factor on the stated ones.
        square: `Σ base x²` of the unknowns of every group.
        determined: how many unknowns of every group the data determine; the prior holds the others.
        misfit: `Σ (y - X x)²` per sensor.
        used: values of every sensor that the unknowns use up.
    """

    x: Float64[Tensor, " unknowns"]
    log_evidence: float
    prior: GaussianPrior
    noise: tuple[float, ...]
    square: Float64[Tensor, " groups"]
    determined: Float64[Tensor, " groups"]
    misfit: tuple[float, ...]
    used: tuple[float, ...]

    @property
    def effective(self) -> float:
        """Number of unknowns that the data determine, those without prior knowledge among them."""
        return float(self.determined.sum()) + int((self.prior.base == 0).sum())


@dataclass(frozen=True)
class SensorCount:
    """What a regression knows of one sensor.

    Attributes:
        values: that count as independent.
        stated: whether its rows state their noise, which then is at least as large.
        exact: whether it is exactly as stated.
        repetition: see `SensorValues.repetition`.
    """

    values: float
    stated: bool
    exact: bool
    repetition: float = 1.0


class AbstractRegression(ABC):
    """Weighted linear regression `y = X x + e` of measured values on unknowns with a normal prior.

    Attributes:
        sensors: how many values there are of every sensor.
    """

    sensors: tuple[SensorCount, ...]

    @abstractmethod
    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """The posterior under a prior and noise; the log evidence is that of MacKay 1992, eq. (4.9)."""

    @abstractmethod
    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Root of the covariance of the unknowns."""

    def effective_share(self, posterior: Posterior) -> float:
        """Share of the values that the unknowns use up; near 1 nothing is left that tells noise from error."""
        values = sum(sensor.values for sensor in self.sensors if not sensor.exact)
        return posterior.effective / max(values, 1.0)

    def renewed_noise(self, posterior: Posterior) -> tuple[float, ...]:
        """Noise of every sensor from its misfit and the values that the unknowns use up (Förstner 1979)."""
        noise = list(posterior.noise)
        for k, sensor in enumerate(self.sensors):
            if not sensor.exact and sensor.values > 0.5:  # without values it stays as it is
                sigma = math.sqrt(posterior.misfit[k] / max(sensor.values - posterior.used[k], 1.0))
                noise[k] = max(sigma, 1.0 if sensor.stated else SMALLEST_NOISE)
        return tuple(noise)

    def maximise_evidence(
        self, prior: GaussianPrior, noise: tuple[float, ...], iterations: int = 40, tolerance: float = 0.2
    ) -> Posterior:
        """Estimate prior sizes and noise together with the unknowns.

        Args:
            prior: with sizes to start from.
            noise: to start from.
            iterations: updates at most.
            tolerance: the search ends when the log evidence rises by less.

        Returns:
            The posterior of the last update.
        """
        posterior = self.solve(prior, tuple(max(sigma, SMALLEST_NOISE) for sigma in noise))
        for _ in range(iterations):
            prior = posterior.prior.updated(posterior.square, posterior.determined)
            following = self.solve(prior, self.renewed_noise(posterior))
            gain = following.log_evidence - posterior.log_evidence
            posterior = following
            if abs(gain) < tolerance:
                break
        return posterior


def root_of_sizes(posterior: Posterior, root: CovarianceRoot) -> Float64[Tensor, "unknowns groups"]:
    """What the uncertainty of the prior's sizes adds to a root of the covariance C of the unknowns.

    With `dx / d log s_g = 2 C Λ_g x` for the unknowns of group g and `var(log s_g) = 1 / (2 n_g)`, where n_g of
    them are determined by the data (first order; Kass and Steffey 1989, J. Amer. Statist. Assoc. 84(407), 717-726).
    """
    prior, x = posterior.prior, posterior.x
    groups = torch.zeros(len(x), len(prior.sizes), dtype=x.dtype, device=x.device)
    groups[torch.arange(len(x)), prior.group] = 1.0
    certain = posterior.determined > LEAST_EFFECTIVE
    moved = 2 * root.covariance_times((groups * (prior.precision * x)[:, None])[:, certain])
    return moved * (2 * posterior.determined[certain]).rsqrt()
