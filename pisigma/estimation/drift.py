"""How much every group of unknowns has drifted since a calibration, by the evidence of new rows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_factor
from pisigma.estimation.regression import SensorCount

SIZES = torch.logspace(-6, -0.5, 56, dtype=torch.float64)
"""Sizes that are tried: 1 µm to 0.3 m, 0.0001 to 18 deg; of corrections, shares of ten times their usual size."""
WORTH = 4.0
"""[nats] By so much a drift has to raise the log evidence: prior odds of about 1 to 50 for a group of the arm."""
WORTH_OF_WRONG = math.log(100)
"""[nats] The same of a wrong configuration of any number of them: prior odds of 1 to 100 that one is."""
SWEEPS = 3
NOISE_FACTORS = torch.linspace(-1.0, 1.6, 14, dtype=torch.float64).exp()
"""Factors on the noise of the calibration that are tried."""
NOISE_SPREAD = 0.3
"""Standard deviation of the logarithm of the noise beside that of the calibration."""


@dataclass(frozen=True, eq=False)
class DriftGroup:
    """Unknowns that drift by about as much: independent, of standard deviation `size · scale`.

    Attributes:
        what: has moved, such as "joint 3", "base" or "correction".
        index: of its unknowns.
        scale: of every unknown at size 1 [m or rad].
        size: 0 where it has not drifted.
        stands: whether the size is stated rather than estimated, as that of a base which stands elsewhere.
        worth: [nats] by so much its drift has to raise the log evidence.
        single: whether it is one motion, rather than many ways to err otherwise than before.
    """

    what: str
    index: Int64[Tensor, " members"]
    scale: Float64[Tensor, " members"]
    size: float = 0.0
    stands: bool = False
    worth: float = WORTH
    single: bool = True

    @property
    def deviation(self) -> Float64[Tensor, " members"]:
        """Standard deviation of every unknown's drift [m or rad]."""
        return self.size * self.scale


@dataclass(frozen=True, eq=False)
class LinearValues:
    """Measured values, linear in the unknowns: `y = X u + e` with u counted from the most probable values of a model.

    Attributes:
        X: weighted derivatives.
        y: weighted residuals of the model.
        sensor: number of every value's sensor.
        configuration: number of the joint values at which every value was measured.
        counts: of the sensors.
        wrong: configurations that were measured wrongly, each with the factor on its noise.
    """

    X: Float64[Tensor, "values unknowns"]
    y: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]
    configuration: Int64[Tensor, " values"]
    counts: tuple[SensorCount, ...]
    wrong: Mapping[int, float] = field(default_factory=dict)

    def select(self, values: Tensor) -> "LinearValues":
        """Select some of the values."""
        names = ("X", "y", "sensor", "configuration")
        return replace(self, **{name: getattr(self, name)[values] for name in names})

    def deviation(self, noise: Float64[Tensor, " sensors"]) -> Float64[Tensor, " values"]:
        """Standard deviation of the noise of every value, by those of the sensors."""
        deviation = noise[self.sensor]
        for number, factor in self.wrong.items():
            wrong = (self.configuration == number) & ~self.exact
            deviation = torch.where(wrong, math.hypot(1.0, factor) * deviation, deviation)
        return deviation

    @property
    def exact(self) -> Bool[Tensor, " values"]:
        """Whether every value is exactly as stated, rather than measured."""
        return torch.tensor([one.exact for one in self.counts])[self.sensor]

    @property
    def worth(self) -> float:
        """[nats] By so much the wrong configurations together have to raise the log evidence."""
        count = len(torch.unique(self.configuration))
        return len(self.wrong) * (WORTH_OF_WRONG + math.log(max(count, 1)))


@dataclass(frozen=True, eq=False)
class Drift:
    """Sizes of the drift of all groups, and the noise of the new rows.

    Attributes:
        groups: with their sizes.
        noise: per sensor [m or rad], or a factor where the rows state it.
        log_evidence: of the new rows, with the prior odds of the drifts and of wrong configurations.
    """

    groups: tuple[DriftGroup, ...]
    noise: Float64[Tensor, " sensors"]
    log_evidence: float = -math.inf


class DriftSearch:
    """The evidence of new rows under a model's posterior that has drifted.

    With A the derivatives by the directions of the posterior's root, Z_g those by the unknowns of a group times their
    scale, and u ~ N(0, R R^T + Σ_g drift), the values are normal with the covariance
    `V = A A^T + Σ_g size_g² Z_g Z_g^T + noise²`. Sizes are chosen one after the other, each with all others as they
    are: for the eigenvalues λ and coordinates b of a group in the metric of the rest, a size s raises the log evidence
    by `Σ (s² λ b² / (1 + s² λ) - log(1 + s² λ)) / 2` (Tipping and Faul 2003, Fast marginal likelihood maximisation for
    sparse Bayesian models, eq. 18, for groups instead of single columns).
    """

    def __init__(
        self,
        values: LinearValues,
        A: Float64[Tensor, "values directions"],
        groups: Sequence[DriftGroup],
        noise: Float64[Tensor, " sensors"],
        usual_noise: Float64[Tensor, " sensors"],
    ) -> None:
        """Start with the sizes of some groups and a noise.

        Args:
            values: the new rows.
            A: their derivatives by the directions of the root.
            groups: with sizes to start from.
            noise: to start from.
            usual_noise: that of the calibration.
        """
        self.values, self._K = values, A @ A.t()
        self._groups, self._noise, self._usual = list(groups), noise.clone(), usual_noise
        self._Z = [fewest_columns(values.X[:, one.index] * one.scale) for one in groups]
        self.covariance = self._K + self.deviation.square().diag()
        for one, Z in zip(self._groups, self._Z, strict=True):
            self.covariance += one.size**2 * Z @ Z.t()

    def estimate(self, sweeps: int = SWEEPS) -> None:
        """Estimate sizes and noise, group after group and sensor after sensor."""
        for _ in range(sweeps):
            before = [one.size for one in self._groups]
            for number, group in enumerate(self._groups):
                if not group.stands:
                    self._resize(number, self._best_size(number))
            for sensor, count in enumerate(self.values.counts):
                if not count.exact and count.values:
                    self._renew_noise(sensor, 1.0 if count.stated else 0.0)
            if before == [one.size for one in self._groups]:
                break

    @property
    def drift(self) -> Drift:
        """Sizes and noise as they are now."""
        return Drift(tuple(self._groups), self._noise, self.log_evidence)

    @property
    def log_evidence(self) -> float:
        """See `Drift`."""
        return self._log_evidence(self.covariance)

    @property
    def deviation(self) -> Float64[Tensor, " values"]:
        """Of every value's noise."""
        return self.values.deviation(self._noise)

    def shift(
        self, number: int, held: bool = True
    ) -> tuple[Float64[Tensor, " members"], Float64[Tensor, "members members"]]:
        """Estimate how far the unknowns of a group have moved, everything else as by its own size.

        Args:
            number: of the group.
            held: by its size, too; else it may have moved by anything.

        Returns:
            The shifts [m or rad] and their covariance.
        """
        group, (_, a, W) = self._groups[number], self._beside(number, reduced=False)
        normal = W.t() @ W
        if held:
            normal.diagonal().add_(group.size**-2)
        covariance = torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
        return (covariance @ (W.t() @ a)) * group.scale, covariance * group.scale * group.scale[:, None]

    def _best_size(self, number: int) -> float:
        raised = gains(SIZES, *self._coordinates(number))
        best = int(raised.argmax())
        return float(SIZES[best]) if float(raised[best]) > self._groups[number].worth else 0.0

    def _coordinates(self, number: int) -> tuple[Tensor, Tensor]:
        """Eigenvalues of a group's covariance in the metric of the rest, and squared coordinates of the values."""
        _, a, W = self._beside(number)
        return coordinates(W, a)

    def _beside(self, number: int, reduced: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """A group's columns, and values and columns in the metric of everything else."""
        group, Z, y = self._groups[number], self._Z[number], self.values.y
        V = self.covariance - group.size**2 * Z @ Z.t()
        if not reduced:
            Z = self.values.X[:, group.index] * group.scale
        both = torch.linalg.solve_triangular(covariance_factor(V), torch.cat([y[:, None], Z], 1), upper=False)
        return Z, both[:, 0], both[:, 1:]

    def _resize(self, number: int, size: float) -> None:
        group, Z = self._groups[number], self._Z[number]
        self.covariance += (size**2 - group.size**2) * Z @ Z.t()
        self._groups[number] = replace(group, size=size)

    def _renew_noise(self, sensor: int, least: float) -> None:
        """Take the factor on the usual noise that has the highest evidence, with a log-normal prior."""
        variance, now = (
            self.values.deviation(torch.ones_like(self._noise)).square(),
            float(self._noise[sensor]),
        )
        variance = variance * (self.values.sensor == sensor)
        tried = []
        for factor in NOISE_FACTORS.tolist():
            sigma = max(factor * float(self._usual[sensor]), least)
            V = self.covariance + (variance * (sigma**2 - now**2)).diag()
            tried.append((self._log_evidence(V) - 0.5 * (math.log(factor) / NOISE_SPREAD) ** 2, sigma))
        sigma = max(tried)[1]
        self.covariance += (variance * (sigma**2 - now**2)).diag()
        self._noise[sensor] = sigma

    def _log_evidence(self, V: Tensor) -> float:
        factor = covariance_factor(V)
        a = torch.linalg.solve_triangular(factor, self.values.y[:, None], upper=False)
        odds = self.values.worth + sum(one.worth for one in self._groups if one.size > 0 and not one.stands)
        return -0.5 * float(a.square().sum()) - float(factor.diagonal().log().sum()) - odds


def coordinates(
    W: Float64[Tensor, "values columns"], a: Float64[Tensor, " values"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
    """Eigenvalues of a group's covariance, and squared coordinates of the values, in the metric of everything else."""
    eigenvalues, U = torch.linalg.eigh(W.t() @ W)  # several times as fast as the singular values of W
    eigenvalues = eigenvalues.clamp(min=1e-15 * float(eigenvalues[-1]) + 1e-300)
    return eigenvalues, (U.t() @ (W.t() @ a)).square() / eigenvalues


def gains(
    sizes: Float64[Tensor, "sizes *#groups"],
    eigenvalues: Float64[Tensor, "*groups k"],
    squares: Float64[Tensor, "*groups k"],
) -> Float64[Tensor, "sizes *groups"]:
    """By how much sizes of a group, or of several, raise the log evidence; see `DriftSearch`."""
    ratio = sizes.square()[..., None] * eigenvalues
    raised: Tensor = 0.5 * (ratio / (1 + ratio) * squares - ratio.log1p()).sum(-1)
    return raised


def fewest_columns(Z: Float64[Tensor, "values members"]) -> Float64[Tensor, "values columns"]:
    """Columns with the same `Z Z^T`, no more than there are values."""
    if Z.shape[1] <= len(Z):
        return Z
    columns: Tensor = torch.linalg.qr(Z.t(), mode="r").R.t()
    return columns
