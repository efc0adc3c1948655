"""Estimate the drift of groups of unknowns since a calibration, from the evidence of new rows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.estimation.cholesky import covariance_cholesky, scaled_cholesky
from pisigma.estimation.regression import SensorValueCount

SIZES = torch.logspace(-6, -0.5, 56, dtype=torch.float64)
"""Drift sizes that are tried: 1 µm to 0.3 m, 0.0001 to 18 deg and, for corrections, shares of ten times the usual
size."""
LOG_PRIOR_PENALTY = 4.0
"""Increase of the log evidence that a drift requires [nats]: prior odds of about 1 to 50 for a group of the arm."""
_WRONG_ROW_PENALTY = math.log(100)
"""Increase of the log evidence that a wrong configuration requires [nats]: prior odds of 1 to 100."""
_MAX_SWEEPS = 3
NOISE_FACTORS = torch.linspace(-1.0, 1.6, 14, dtype=torch.float64).exp()
"""Factors on the noise of the calibration that are tried."""
NOISE_SPREAD = 0.3
"""Prior standard deviation of the log ratio of the noise to that of the calibration."""


@dataclass(frozen=True, eq=False)
class DriftGroup:
    """Unknowns that drift together, independently of each other, with a common `drift_size`.

    Attributes:
        name: name of the group, such as "joint 3", "base" or "correction".
        index: indices of the unknowns of the group.
        sigma_at_unit_size: standard deviation of every unknown at size 1 [m or rad]; it is proportional to the size.
        drift_size: size of the drift; 0 if the group has not drifted.
        fixed_size: whether the size is stated rather than estimated, as for a base that was relocated.
        log_prior_penalty: increase of the log evidence that a drift of the group requires [nats].
        is_one_motion: whether the group is one motion rather than a set of many independent changes.
    """

    name: str
    index: Int64[Tensor, " members"]
    sigma_at_unit_size: Float64[Tensor, " members"]
    drift_size: float = 0.0
    fixed_size: bool = False
    log_prior_penalty: float = LOG_PRIOR_PENALTY
    is_one_motion: bool = True

    @property
    def sigma(self) -> Float64[Tensor, " members"]:
        """Standard deviation of every unknown's drift [m or rad]."""
        return self.drift_size * self.sigma_at_unit_size


@dataclass(frozen=True, eq=False)
class LinearValues:
    """Measured values `y = X u + e` with unknowns u relative to the most probable values of a model.

    Attributes:
        X: weighted derivatives.
        y: weighted residuals of the model.
        sensor: index of every value's sensor.
        configuration: index of the joint values at which every value was measured.
        sensor_counts: number of values of every sensor.
        wrong_configurations: configurations with wrong measurements, with the factors on their noise.
        rejected: indices of the rows whose values the loss rejects; they have no values here.
    """

    X: Float64[Tensor, "values unknowns"]
    y: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]
    configuration: Int64[Tensor, " values"]
    sensor_counts: tuple[SensorValueCount, ...]
    wrong_configurations: Mapping[int, float] = field(default_factory=dict)
    rejected: frozenset[int] = frozenset()

    def select(self, values: Tensor) -> "LinearValues":
        """Return a subset of the values, given by a mask or indices."""
        names = ("X", "y", "sensor", "configuration")
        return replace(self, **{name: getattr(self, name)[values] for name in names})

    def sigma(self, noise: Float64[Tensor, " sensors"]) -> Float64[Tensor, " values"]:
        """Return the standard deviation of the noise of every value, given that of every sensor."""
        deviation = noise[self.sensor]
        for number, factor in self.wrong_configurations.items():
            wrong = (self.configuration == number) & ~self.has_exact_noise
            deviation = torch.where(wrong, math.hypot(1.0, factor) * deviation, deviation)
        return deviation

    @property
    def has_exact_noise(self) -> Bool[Tensor, " values"]:
        """Mask of the values whose noise is exactly as stated."""
        return torch.tensor([one.has_exact_noise for one in self.sensor_counts])[self.sensor]

    @property
    def log_prior_penalty(self) -> float:
        """Increase of the log evidence that all wrong configurations together require [nats]."""
        count = len(torch.unique(self.configuration))
        return len(self.wrong_configurations) * (_WRONG_ROW_PENALTY + math.log(max(count, 1)))


@dataclass(frozen=True, eq=False)
class Drift:
    """Drift sizes of all groups, and noise of the new rows.

    Attributes:
        groups: groups with their sizes.
        noise: noise of every sensor [m or rad], or a factor on the noise that the rows state.
        log_evidence: log evidence of the new rows, including the prior odds of drifts and wrong configurations.
    """

    groups: tuple[DriftGroup, ...]
    noise: Float64[Tensor, " sensors"]
    log_evidence: float = -math.inf


class DriftSearch:
    """Search for the drift sizes that maximise the evidence of new rows under a model's posterior.

    With the derivatives A along the columns of the posterior's root, the derivatives Z_g with respect to the unknowns
    of group g times their scale, and u ~ N(0, R R^T + Σ_g drift), the values are normal with the covariance `V = A A^T
    + Σ_g size_g² Z_g Z_g^T + noise²`. Sizes are optimised one at a time with all others fixed: for the eigenvalues λ
    and coordinates b of a group in the metric of the other terms, a size s raises the log evidence by `Σ (s² λ b² / (1
    + s² λ) - log(1 + s² λ)) / 2` (Tipping and Faul 2003, Fast marginal likelihood maximisation for sparse Bayesian
    models, eq. 18, for groups instead of single columns).
    """

    def __init__(
        self,
        values: LinearValues,
        A: Float64[Tensor, "values directions"],
        groups: Sequence[DriftGroup],
        noise: Float64[Tensor, " sensors"],
        usual_noise: Float64[Tensor, " sensors"],
    ) -> None:
        """Start with initial sizes and noise.

        Args:
            values: values of the new rows.
            A: derivatives of the values along the columns of the posterior's covariance root.
            groups: groups with initial sizes.
            noise: initial noise of every sensor.
            usual_noise: noise of the calibration.
        """
        self.values, self._K = values, A @ A.t()
        self._groups, self._noise, self._usual = list(groups), noise.clone(), usual_noise
        self._Z = [compressed_columns(values.X[:, one.index] * one.sigma_at_unit_size) for one in groups]
        self.covariance = self._K + self.sigma.square().diag()
        for one, Z in zip(self._groups, self._Z, strict=True):
            self.covariance += one.drift_size**2 * Z @ Z.t()

    def estimate_sizes(self, sweeps: int = _MAX_SWEEPS) -> None:
        """Estimate sizes and noise, one group and one sensor at a time."""
        for _ in range(sweeps):
            before = [one.drift_size for one in self._groups]
            for number, group in enumerate(self._groups):
                if not group.fixed_size:
                    self._resize(number, self._best_size(number))
            for sensor, count in enumerate(self.values.sensor_counts):
                if not count.has_exact_noise and count.values:
                    self._update_noise(sensor, 1.0 if count.has_stated_noise else 0.0)
            if before == [one.drift_size for one in self._groups]:
                break

    @property
    def drift(self) -> Drift:
        """Current drift sizes and noise."""
        return Drift(tuple(self._groups), self._noise, self.log_evidence)

    @property
    def log_evidence(self) -> float:
        """See `Drift`."""
        return self._log_evidence(self.covariance)

    @property
    def sigma(self) -> Float64[Tensor, " values"]:
        """Standard deviation of the noise of every value."""
        return self.values.sigma(self._noise)

    def estimate_shift(
        self, group_index: int, with_prior: bool = True
    ) -> tuple[Float64[Tensor, " members"], Float64[Tensor, "members members"]]:
        """Estimate how far the unknowns of a group have moved, with the sizes of all other groups unchanged.

        Args:
            group_index: index of the group.
            with_prior: whether to use the prior of the group; if not, its unknowns are unconstrained.

        Returns:
            The shifts [m or rad] and their covariance.
        """
        group, (_, a, W) = self._groups[group_index], self._whitened(group_index, reduced=False)
        normal = W.t() @ W
        if with_prior:
            normal.diagonal().add_(group.drift_size**-2)
        covariance = torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
        scale = group.sigma_at_unit_size
        return (covariance @ (W.t() @ a)) * scale, covariance * scale * scale[:, None]

    def _best_size(self, number: int) -> float:
        raised = evidence_gains(SIZES, *self._coordinates(number))
        best = int(raised.argmax())
        return float(SIZES[best]) if float(raised[best]) > self._groups[number].log_prior_penalty else 0.0

    def _coordinates(self, number: int) -> tuple[Tensor, Tensor]:
        """Return the eigenvalues of a group's covariance in the metric of the other terms, and squared coordinates."""
        _, a, W = self._whitened(number)
        return diagonalise_evidence(W, a)

    def _whitened(self, number: int, reduced: bool = True) -> tuple[Tensor, Tensor, Tensor]:
        """Return a group's columns, and values and columns in the metric of all other terms."""
        group, Z, y = self._groups[number], self._Z[number], self.values.y
        V = self.covariance - group.drift_size**2 * Z @ Z.t()
        if not reduced:
            Z = self.values.X[:, group.index] * group.sigma_at_unit_size
        both = torch.linalg.solve_triangular(
            covariance_cholesky(V), torch.cat([y[:, None], Z], 1), upper=False
        )
        return Z, both[:, 0], both[:, 1:]

    def _resize(self, number: int, size: float) -> None:
        group, Z = self._groups[number], self._Z[number]
        self.covariance += (size**2 - group.drift_size**2) * Z @ Z.t()
        self._groups[number] = replace(group, drift_size=size)

    def _update_noise(self, sensor: int, least: float) -> None:
        """Update the noise of a sensor with the factor of highest evidence on its usual noise (log-normal prior)."""
        variance, now = (
            self.values.sigma(torch.ones_like(self._noise)).square(),
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
        factor = covariance_cholesky(V)
        a = torch.linalg.solve_triangular(factor, self.values.y[:, None], upper=False)
        estimated = [one for one in self._groups if one.drift_size > 0 and not one.fixed_size]
        odds = self.values.log_prior_penalty + sum(one.log_prior_penalty for one in estimated)
        return -0.5 * float(a.square().sum()) - float(factor.diagonal().log().sum()) - odds


def diagonalise_evidence(
    whitened_columns: Float64[Tensor, "values columns"], whitened_values: Float64[Tensor, " values"]
) -> tuple[Float64[Tensor, " k"], Float64[Tensor, " k"]]:
    """Return the eigenvalues of a group's covariance and the squared coordinates of the values in its axes."""
    # several times as fast as the singular values of the columns
    eigenvalues, U = torch.linalg.eigh(whitened_columns.t() @ whitened_columns)
    eigenvalues = eigenvalues.clamp(min=1e-15 * float(eigenvalues[-1]) + 1e-300)
    return eigenvalues, (U.t() @ (whitened_columns.t() @ whitened_values)).square() / eigenvalues


def evidence_gains(
    sizes: Float64[Tensor, "sizes *#groups"],
    eigenvalues: Float64[Tensor, "*groups k"],
    squares: Float64[Tensor, "*groups k"],
) -> Float64[Tensor, "sizes *groups"]:
    """Return the gain of log evidence for sizes of one or several groups; see `DriftSearch`."""
    ratio = sizes.square()[..., None] * eigenvalues
    raised: Tensor = 0.5 * (ratio / (1 + ratio) * squares - ratio.log1p()).sum(-1)
    return raised


def compressed_columns(Z: Float64[Tensor, "values members"]) -> Float64[Tensor, "values columns"]:
    """Return columns with the same product `Z Z^T`, but no more columns than values."""
    if Z.shape[1] <= len(Z):
        return Z
    columns: Tensor = torch.linalg.qr(Z.t(), mode="r").R.t()
    return columns


MAX_DIRECTIONS = 1.2
"""Largest ratio of the number of columns of a covariance root to the number of unknowns."""


class PosteriorUpdate:
    """Kalman's update of a covariance root R: the root of the posterior is `R (I + A^T A)^-1/2` with A = X R / noise.

    For few values it is computed from the eigenvalues of `A A^T`, otherwise from the Cholesky factor of `I + A^T A`.
    Source: Bierman 1977, Factorization Methods for Discrete Sequential Estimation, chapter II.

    Attributes:
        shift: most probable change of the unknowns.
        effective_unknowns: number of directions that the values determine.
    """

    def __init__(
        self, root: Float64[Tensor, "unknowns directions"], values: LinearValues, drift: Drift
    ) -> None:
        """Update the covariance `root root^T` plus the covariance of the drift.

        Args:
            root: covariance root before the values.
            values: new values.
            drift: drift since the root was estimated, and noise of the values.
        """
        self._root = root
        drifted = [group for group in drift.groups if group.drift_size > 0]
        index = torch.cat([group.index for group in drifted] or [torch.zeros(0, dtype=torch.int64)])
        deviation = torch.cat([group.sigma for group in drifted] or [values.y[:0]])
        self._index, self._deviation = index, deviation
        noise = values.sigma(drift.noise)
        # Old uncertainty and drift are independent, so their roots are joined as columns.
        A = torch.cat([values.X @ root, values.X[:, index] * deviation], 1) / noise[:, None]
        y = values.y / noise
        # Work in the smaller of the two spaces: values (A A^T) or directions (A^T A).
        self._few = 2 * len(y) <= A.shape[1]
        if self._few:
            self._eigenvalues, U = torch.linalg.eigh(A @ A.t())
            self._eigenvalues = self._eigenvalues.clamp(min=0.0)
            self._along = A.t() @ U
            z = self._along @ ((U.t() @ y) / (1 + self._eigenvalues))
            self.effective_unknowns = float((self._eigenvalues / (1 + self._eigenvalues)).sum())
        else:
            M = A.t() @ A
            M.diagonal().add_(1.0)
            self._L = torch.linalg.cholesky(M)
            z = torch.cholesky_solve((A.t() @ y)[:, None], self._L)[:, 0]
            self.effective_unknowns = len(M) - float(torch.cholesky_inverse(self._L).trace())
        directions = root.shape[1]
        # z is in units of the roots: the first part moves the old unknowns, the second part those that drifted.
        self.shift = root @ z[:directions]
        self.shift.index_add_(0, index, deviation * z[directions:])

    def covariance_root(self) -> Float64[Tensor, "unknowns directions"]:
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
        # Every update adds columns; if there are many, they are compressed to a triangle with the same product.
        if root.shape[1] <= MAX_DIRECTIONS * len(root):
            return root
        scale, factor = scaled_cholesky(lambda: root @ root.t())
        return torch.where(root.any(1)[:, None], factor / scale[:, None], 0.0)
