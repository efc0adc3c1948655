"""Bayesian linear regression: prior and posterior of the unknowns, and values that were left out."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

SMALLEST_NOISE = 1e-8
"""[m or rad] Floor of the estimated noise: far below what instruments resolve."""
SMALLEST_SIZE = 1e-9
"""Prior size [rad] below which a group of weights is off."""
FIRST_SIZE = 2e-5
"""Prior size [rad] that weights start with."""
RELAXATION = 1.5
"""Steps of MacKay's rule are longer by this, in logarithms; from about 1.8 on they overshoot."""
SINGULAR = 1e-6
"""Share of a left-out value's variance below which no other value says anything of it."""


@dataclass(frozen=True, eq=False)
class GaussianPrior:
    """Independent normal unknowns: precision `base / sizes[group]²`.

    Attributes:
        base: 1 / variance at size 1; 0 where there is no prior knowledge.
        group: number of every unknown's size.
        sizes: standard deviations.
        classes: the first so many groups are classes of geometric parameters. Their sizes, factors on what was
            stated, stand as the geometric calibration found them: over a narrow range of a joint low harmonics look
            like geometry, and where they may take its part the arm errs beyond that range.
    """

    base: Float64[Tensor, " unknowns"]
    group: Int64[Tensor, " unknowns"]
    sizes: Float64[Tensor, " groups"]
    classes: int

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """1 / variance."""
        return self.base / self.sizes[self.group].square()

    def of_groups(self, values: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " groups"]:
        """Sum over the unknowns of every group of which there is prior knowledge."""
        return torch.zeros_like(self.sizes).index_add(0, self.group, values * (self.base > 0))

    def updated(
        self, square: Float64[Tensor, " groups"], determined: Float64[Tensor, " groups"]
    ) -> "GaussianPrior":
        """Sizes by MacKay's rule (1992, Neural Computation 4(3), eq. 4.7), `size² = Σ x² base / Σ determined`.

        As the rule comes near to its fixed point from one side, in ever shorter steps, these are lengthened.
        """
        sizes = (square.clamp(min=0.0) / determined.clamp(min=1e-12)).sqrt()
        sizes = (self.sizes * (sizes / self.sizes) ** RELAXATION).clamp(min=SMALLEST_SIZE)
        stands = (determined <= 1e-9) | (torch.arange(len(sizes), device=sizes.device) < self.classes)
        return replace(self, sizes=torch.where(stands, self.sizes, sizes))


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


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Errors of values that were left out, in standard deviations of the noise.

    Attributes:
        error: measured minus predicted.
        spread: its predicted standard deviation, parameters and noise.
        sensor: number of every value's sensor.
    """

    error: Float64[Tensor, " values"]
    spread: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]

    @staticmethod
    def of(
        M: Float64[Tensor, "values values"],
        residual: Float64[Tensor, " values"],
        sensor: Int64[Tensor, " values"],
        counts: Sequence[SensorCount],
    ) -> "LeftOut":
        """Of the values of a fold, from a fit to all values: errors `M^-1 r` of the covariance `M^-1`.

        Where only these values determine an unknown, such as where a socket is, M is singular; that unknown counts as
        fitted to them, and the errors are scaled by what that takes away (Cook and Weisberg 1982, section 2.2).

        Args:
            M: block of `I - X C X^T` of the values, whitened.
            residual: r, whitened.
            sensor: number of every value's sensor.
            counts: of the sensors.
        """
        factor, failed = torch.linalg.cholesky_ex(M)
        if len(M) and (failed or float(factor.diagonal().min()) ** 2 < SINGULAR):
            values, vectors = torch.linalg.eigh(M)
            certain = values > SINGULAR
            inverse = (vectors * torch.where(certain, 1 / values, 0.0)) @ vectors.t()
            residual = residual * (len(M) / max(int(certain.sum()), 1)) ** 0.5
        else:
            inverse = torch.cholesky_inverse(factor)
        repetition = residual.new_tensor([one.repetition for one in counts])[sensor]
        spread = 1 + repetition * (inverse.diagonal() - 1).clamp(min=0)
        return LeftOut((inverse @ residual) * repetition.sqrt(), spread.sqrt(), sensor)

    @staticmethod
    def joined(parts: "Sequence[LeftOut]") -> "LeftOut":
        """One after the other."""
        names = ("error", "spread", "sensor")
        return LeftOut(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def rms(self, noise: Sequence[float], unit: Sequence[float]) -> float:
        """Root mean square in other standard deviations than those of the noise, such as that of another model."""
        return float(self._squares(noise, unit).mean().sqrt())

    def gain(self, noise: Sequence[float], before: "LeftOut", noise_before: Sequence[float]) -> float:
        """By how many standard errors the squares of the same values are smaller than another fit's."""
        return standard_errors(
            before._squares(noise_before, noise_before) - self._squares(noise, noise_before)
        )

    def _squares(self, noise: Sequence[float], unit: Sequence[float]) -> Float64[Tensor, " values"]:
        scale = self.error.new_tensor(noise) / self.error.new_tensor(unit)
        return (self.error * scale[self.sensor]).square()


def standard_errors(values: Float64[Tensor, " values"]) -> float:
    """The sum of independent values over its standard error; 0 where all are the same."""
    scatter = (values.square().sum() - values.sum().square() / max(len(values), 1)).clamp(min=0).sqrt()
    return float(values.sum() / scatter) if float(scatter) > 0 else 0.0
