"""Bayesian linear regression in dual form, for few values: with their covariance, as in Gaussian processes."""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.estimation.cholesky import invert_from_factor, log_determinant, scaled_cholesky
from pisigma.estimation.covariance_root import CovarianceRoot, ImplicitCovarianceRoot
from pisigma.estimation.primal_regression import PrimalRegression, sum_log_noise_variance
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import AbstractRegression, Posterior, SensorValueCount

DETERMINED = 1e-9
"""Share of the precision of a value, or of the best determined unknown, below which it is treated as undetermined."""
_MAX_VARIANCE_RATIO = 1e6
"""Ratio of the values' prior variances to the noise variance up to which traces of P are accurate to 1e-4."""


@dataclass(frozen=True, eq=False)
class DualRegression(AbstractRegression):
    """Regression by the values' covariance `V = Σ_g size_g² K_g + noise²` under the prior of the weights.

    With the columns G of the parameters and Z of the weights, `K_g = Σ_i Z_i Z_i^T / base_i` over the weights of group
    g, and `P = V^-1 - V^-1 G (G^T V^-1 G + Λ)^-1 G^T V^-1`::

        parameters = (G^T V^-1 G + Λ)^-1 G^T V^-1 y        weights_i = size² / base_i · Z_i^T P y
        determined_g = size_g² tr(P K_g)                    y - X x = noise² P y

    By Woodbury's identity, posterior and evidence are those of `PrimalRegression`. Source: Rasmussen and Williams,
    Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7 and 5.4.

    Attributes:
        X: weighted columns, the parameters first.
        y: weighted values.
        sensor: index of every value's sensor.
        prior: prior that defines the groups and base of the matrices K; its sizes are not used.
        active_count: number of parameters.
        K: matrix K of every group of weights, lower triangle.
        sensors: number of values of every sensor.
    """

    X: Float64[Tensor, "values unknowns"]
    y: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]
    prior: GaussianPrior
    active_count: int
    K: Float64[Tensor, "groups pairs"]
    sensors: tuple[SensorValueCount, ...]

    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """Compute the posterior for a prior and noise; see `AbstractRegression.solve`."""
        if self.is_ill_conditioned(prior, noise):
            return self.primal_regression.solve(prior, noise)
        P, parameters, covariance, log_det = self.projection(prior, noise)
        active, precision = self.active_count, prior.precision
        variance = self.y.new_tensor(noise).square()[self.sensor]
        # alpha = V^-1 (y - G parameters); both weights and residuals are products with alpha.
        alpha = P @ self.y
        x = torch.cat([parameters, (self.X.t() @ alpha)[active:] / precision[active:]])
        square = prior.sum_by_group(x.square() * prior.unit_precision)
        # A parameter is determined by the data to the extent that its posterior variance is below the prior variance.
        held = torch.zeros_like(x)
        held[:active] = 1 - precision[:active] * covariance.diagonal()
        determined = prior.sum_by_group(held)
        # Both matrices are symmetric, so the trace of their product requires only one triangle.
        traces = self.K @ (P.flatten().index_select(0, self._pairs) * self._counts)
        determined[prior.geometric_class_count :] = (
            prior.group_scales[prior.geometric_class_count :].square() * traces
        )
        # Parameters without a prior have precision 0; their constant term is left out.
        stated = precision[:active]
        evidence = float(self.y @ alpha) + log_det - float(stated[stated > 0].log().sum())
        # |V| contains the noise of all values; repeated poses count as fewer independent poses (`SensorValueCount`).
        evidence += sum_log_noise_variance(self.sensors, noise) - float(variance.log().sum())
        # Residuals are variance · alpha; the leverage of a value is 1 - variance · P_ii.
        misfit = self._by_sensor((variance * alpha).square())
        used = self._by_sensor(1 - variance * P.diagonal())
        return Posterior(x, -0.5 * evidence, prior, noise, square, determined, misfit, used)

    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Return the covariance root of the unknowns; weights depend on the parameters by `-Λ^-1 X^T V^-1 G`."""
        if self.is_ill_conditioned(posterior.prior, posterior.noise):
            return self.primal_regression.covariance_root(posterior)
        active, precision = self.active_count, posterior.prior.precision
        sigma = self.y.new_tensor(posterior.noise)[self.sensor]
        size = precision[active:].rsqrt()
        G, Z = self.X[:, :active] / sigma[:, None], self.X[:, active:] / sigma[:, None] * size
        V = Z @ Z.t()
        V.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(V)
        # Parameters first, with the weights integrated out (V); then the weights, which follow the parameters.
        inner = torch.linalg.solve_triangular(factor, G, upper=False)
        normal = inner.t() @ inner
        normal.diagonal().add_(precision[:active])
        scale, lower = scaled_cholesky(normal.clone)
        root = torch.linalg.solve_triangular(lower, torch.diag(scale), upper=False).t()
        follow = torch.linalg.solve_triangular(factor.t(), inner @ root, upper=True)
        directions = torch.cat([root, -size[:, None] * (Z.t() @ follow)])
        return CovarianceRoot(directions, ImplicitCovarianceRoot(size, Z, factor))

    @cached_property
    def primal_regression(self) -> PrimalRegression:
        """The regression in primal form, with the same values."""
        return PrimalRegression(*self.normal_equation_sums, self.sensors)

    @property
    def normal_equation_sums(self) -> tuple[Tensor, Tensor, tuple[float, ...]]:
        """Sums of the normal equations for every sensor: `X^T X`, `X^T y` and `y^T y`."""
        parts = [
            (self.X[rows], self.y[rows]) for rows in (self.sensor == k for k in range(len(self.sensors)))
        ]
        normal = torch.stack([X.t() @ X for X, _ in parts])
        return normal, torch.stack([X.t() @ y for X, y in parts]), tuple(float(y @ y) for _, y in parts)

    def is_ill_conditioned(self, prior: GaussianPrior, noise: tuple[float, ...]) -> bool:
        """Return whether traces of P cancel because the noise is very small; normal equations are then accurate."""
        diagonal = torch.arange(len(self.y)).add(1).cumsum(0) - 1
        trace = float(prior.group_scales[prior.geometric_class_count :].square() @ self.K[:, diagonal].sum(1))
        return trace > _MAX_VARIANCE_RATIO * min(noise) ** 2

    def _covariance(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Tensor:
        """Return V, of which only the upper triangle is set."""
        V = self.y.new_zeros((len(self.y), len(self.y)))
        V.view(-1)[self._pairs] = prior.group_scales[prior.geometric_class_count :].square() @ self.K
        V.diagonal().add_(self.y.new_tensor(noise).square()[self.sensor])
        return V

    @cached_property
    def _pairs(self) -> Int64[Tensor, " pairs"]:
        """Indices of the pairs of values in a row-major matrix."""
        return _upper_triangle(len(self.y))

    @cached_property
    def _counts(self) -> Float64[Tensor, " pairs"]:
        """Number of entries of a symmetric matrix for each pair of values: 1 on the diagonal, otherwise 2."""
        return torch.where(self._pairs % (len(self.y) + 1) == 0, 1.0, 2.0).to(self.y)

    def projection(
        self, prior: GaussianPrior, noise: tuple[float, ...]
    ) -> tuple[Tensor, Tensor, Tensor, float]:
        """Return P, the parameters and their covariance, and `log |V| + log |G^T V^-1 G + Λ|`."""
        active = self.active_count
        factor = scaled_cholesky(lambda: self._covariance(prior, noise))
        log_det = log_determinant(*factor)
        inverse, G = invert_from_factor(*factor), self.X[:, :active]
        along = inverse @ G
        normal = G.t() @ along
        normal.diagonal().add_(prior.precision[:active])
        factor = scaled_cholesky(normal.clone)
        # Determinant lemma: |V + G Λ^-1 G^T| |Λ| = |V| |G^T V^-1 G + Λ|.
        log_det += log_determinant(*factor)
        covariance = invert_from_factor(*factor)
        parameters = covariance @ (along.t() @ self.y)
        return inverse - along @ covariance @ along.t(), parameters, covariance, log_det

    def _by_sensor(self, values: Tensor) -> tuple[float, ...]:
        """Return the sum over the values of every sensor."""
        sums = torch.zeros(len(self.sensors)).to(values).index_add(0, self.sensor, values)
        return tuple(sums.tolist())


def without_nuisance(
    V: Float64[Tensor, "values values"], G: Float64[Tensor, "values unknowns"]
) -> tuple[Tensor, Tensor, int]:
    """Eliminate unknowns without a prior from values with the covariance V.

    Args:
        V: covariance of the values.
        G: derivatives with respect to the unknowns, some of which the values may not determine.

    Returns:
        `P = V^-1 - V^-1 G (G^T V^-1 G)^-1 G^T V^-1`; the matrix from values to unknowns, `(G^T V^-1 G)^-1 G^T V^-1`;
        and the number of unknowns that the values determine.
    """
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(V))
    along = inverse @ G
    # Unknowns have different units, so they are scaled before their rank is decided.
    scale = G.square().sum(0).clamp(min=1e-300).rsqrt()
    strength, axes = torch.linalg.eigh(G.t() @ along * scale * scale[:, None])
    certain = strength > DETERMINED * strength[-1:]
    axes = scale[:, None] * axes[:, certain]
    solution = axes / strength[certain] @ axes.t() @ along.t()
    return inverse - along @ solution, solution, int(certain.sum())


def group_gram(X: Tensor, prior: GaussianPrior, group: int, active_count: int) -> Tensor:
    """Return the matrix K of one group of weights, whose columns in X follow the columns of the parameters."""
    columns = (prior.group == group).nonzero()[:, 0]
    columns = columns[columns >= active_count]
    Z = X[:, columns] * prior.unit_precision[columns].rsqrt()
    return (Z @ Z.t()).flatten()[_upper_triangle(len(X))]


@lru_cache(maxsize=4)
def _upper_triangle(size: int) -> Int64[Tensor, " pairs"]:
    """Return the indices of the pairs of values in the upper triangle of a row-major matrix."""
    pairs: Tensor = torch.tril_indices(size, size)
    return pairs[1] * size + pairs[0]


def pair_indices(values: Int64[Tensor, " values"]) -> Int64[Tensor, " pairs"]:
    """Return the indices of all pairs of the given values (ascending) among the pairs of all values."""
    first, second = values[torch.tril_indices(len(values), len(values))]
    pairs: Tensor = first * (first + 1) // 2 + second
    return pairs


def stack_groups(K: list[Tensor], y: Tensor) -> Tensor:
    """Stack the matrices K of all groups; the result is empty if there are no weights."""
    return torch.stack(K) if K else y.new_zeros((0, len(y) * (len(y) + 1) // 2))
