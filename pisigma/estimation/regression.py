"""Bayesian linear regression: posterior, and prior scales and noise by maximum evidence."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.prior import GaussianPrior

SMALLEST_NOISE = 1e-8
"""Lower bound of the estimated noise [m or rad], far below the resolution of instruments."""
MIN_EFFECTIVE = 0.5
"""Number of unknowns of a group that the data must determine for its prior scale to matter."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior distribution of the unknowns of a regression.

    Attributes:
        x: most probable values.
        log_evidence: log evidence of the data under the prior, up to a constant that depends only on the data.
        prior: prior with estimated sizes.
        noise: standard deviation of the noise of every sensor [m or rad], or a factor on the stated noise.
        squared_unknowns: `Σ base x²` over the unknowns of every group.
        determined_unknowns: effective number of unknowns of every group that the data determine; the prior determines
            the others.
        misfit: `Σ (y - X x)²` for every sensor.
        effective_parameters: effective number of values of every sensor that the unknowns absorb.
    """

    x: Float64[Tensor, " unknowns"]
    log_evidence: float
    prior: GaussianPrior
    noise: tuple[float, ...]
    squared_unknowns: Float64[Tensor, " groups"]
    determined_unknowns: Float64[Tensor, " groups"]
    misfit: tuple[float, ...]
    effective_parameters: tuple[float, ...]

    @property
    def effective_unknowns(self) -> float:
        """Effective number of unknowns that the data determine, including those without a prior."""
        return float(self.determined_unknowns.sum()) + int((self.prior.unit_precision == 0).sum())


@dataclass(frozen=True)
class SensorValueCount:
    """Number of values of a sensor, and properties of its noise.

    Attributes:
        values: number of independent values.
        has_stated_noise: whether the rows of the sensor state their noise, which is then a lower bound.
        has_exact_noise: whether the noise is exactly as stated.
        repeat_variance_factor: see `SensorValues.repeat_variance_factor`.
    """

    values: float
    has_stated_noise: bool
    has_exact_noise: bool
    repeat_variance_factor: float = 1.0


class AbstractRegression(ABC):
    """Weighted linear regression `y = X x + e` of measured values on unknowns with a normal prior.

    Attributes:
        sensors: number of values of every sensor.
    """

    sensors: tuple[SensorValueCount, ...]

    @abstractmethod
    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """Compute the posterior for a prior and noise; the log evidence is that of MacKay 1992, eq. (4.9)."""

    @abstractmethod
    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Return the covariance root of the unknowns."""

    def absorbed_share(self, posterior: Posterior) -> float:
        """Return the share of the values that the unknowns absorb; if it is near 1, the noise cannot be estimated."""
        values = sum(sensor.values for sensor in self.sensors if not sensor.has_exact_noise)
        return posterior.effective_unknowns / max(values, 1.0)

    def updated_noise(self, posterior: Posterior) -> tuple[float, ...]:
        """Estimate the noise of every sensor from its misfit and degrees of freedom (Förstner 1979)."""
        noise = list(posterior.noise)
        for k, sensor in enumerate(self.sensors):
            if (
                not sensor.has_exact_noise and sensor.values > 0.5
            ):  # the noise of a sensor without values is unchanged
                sigma = math.sqrt(
                    posterior.misfit[k] / max(sensor.values - posterior.effective_parameters[k], 1.0)
                )
                noise[k] = max(sigma, 1.0 if sensor.has_stated_noise else SMALLEST_NOISE)
        return tuple(noise)

    def maximise_evidence(
        self, prior: GaussianPrior, noise: tuple[float, ...], iterations: int = 40, tolerance: float = 0.2
    ) -> Posterior:
        """Estimate prior scales and noise together with the unknowns.

        Args:
            prior: prior with initial sizes.
            noise: initial noise for every sensor.
            iterations: largest number of updates.
            tolerance: increase of the log evidence [nats] below which the iteration has converged.

        Returns:
            The posterior of the last update.
        """
        posterior = self.solve(prior, tuple(max(sigma, SMALLEST_NOISE) for sigma in noise))
        for _ in range(iterations):
            prior = posterior.prior.updated(posterior.squared_unknowns, posterior.determined_unknowns)
            following = self.solve(prior, self.updated_noise(posterior))
            gain = following.log_evidence - posterior.log_evidence
            posterior = following
            if abs(gain) < tolerance:
                break
        return posterior


def prior_scale_columns(
    posterior: Posterior, covariance_root: CovarianceRoot
) -> Float64[Tensor, "unknowns groups"]:
    """Return the columns that the uncertainty of the prior scales adds to a root of the covariance C of the unknowns.

    With `dx / d log s_g = 2 C Λ_g x` for the unknowns of group g and `var(log s_g) = 1 / (2 n_g)`, where n_g of
    them are determined by the data (first order; Kass and Steffey 1989, J. Amer. Statist. Assoc. 84(407), 717-726).
    """
    prior, x = posterior.prior, posterior.x
    groups = torch.zeros(len(x), len(prior.group_scales), dtype=x.dtype, device=x.device)
    groups[torch.arange(len(x)), prior.group] = 1.0
    certain = posterior.determined_unknowns > MIN_EFFECTIVE
    moved = 2 * covariance_root.covariance_times((groups * (prior.precision * x)[:, None])[:, certain])
    return moved * (2 * posterior.determined_unknowns[certain]).rsqrt()
