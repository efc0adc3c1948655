"""What every form of the regression offers: posterior, left-out values, and prior sizes and noise by the evidence."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.covariance_root import CovarianceRoot
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.evidence import SMALLEST_NOISE, GaussianPrior, LeftOut, Posterior, SensorCount
from pisigma.joint_correction.feature import AbstractFeature


class AbstractRegression(ABC):
    """Weighted linear regression `y = X x + e` of all measured values on the unknowns.

    Attributes:
        design: the unknowns.
        sensors: how many values there are of every sensor.
    """

    design: Design
    sensors: tuple[SensorCount, ...]

    @abstractmethod
    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """The posterior under a prior and noise; the log evidence is that of MacKay 1992, eq. (4.9)."""

    @abstractmethod
    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Root of the covariance of the unknowns."""

    @abstractmethod
    def select(self, design: Design) -> "AbstractRegression":
        """The same for the unknowns of a design that has some of the features, or smaller ones."""

    @abstractmethod
    def without(self, groups: Int64[Tensor, " groups"]) -> "AbstractRegression":
        """The same without the values of some groups of rows, see `Rows.group`; values that are certain stay."""

    @abstractmethod
    def left_out(self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]) -> LeftOut:
        """Leave out one fold after the other and predict it, with the prior sizes and the noise of a posterior.

        Args:
            posterior: of all values.
            folds: groups that are left out together, see `Rows.group`.
        """

    def left_out_anew(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]], updates: int
    ) -> LeftOut:
        """The same with so many updates of noise and prior sizes for every fold: few rows leave these uncertain."""
        parts = []
        for groups in folds:
            rest = self.without(groups).maximise_evidence(posterior.prior, posterior.noise, updates)
            parts.append(self.left_out(rest, [groups]))
        return LeftOut.joined(parts)

    def first_sizes(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Float64[Tensor, " groups"] | None]:
        """By how much more features raise the log evidence with all other prior sizes and the noise fixed.

        Args:
            posterior: without them.
            design: without them.
            features: that are added.

        Returns:
            The gain, infinite where a fit says it as quickly; and the prior sizes of the features, to start from.
        """
        return math.inf, None

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
