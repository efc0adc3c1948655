"""Regression by the covariance of the values, for few values and many unknowns, and which form is the cheaper one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.abstract_regression import AbstractRegression
from pisigma.calibration.hybrid.covariance_root import CovarianceRoot, FewValues
from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.calibration.hybrid.evidence import (
    GaussianPrior,
    LeftOut,
    Posterior,
    SensorCount,
)
from pisigma.calibration.hybrid.normal_equations import (
    NormalEquations,
    factored,
    inverted,
    log_determinant,
    log_noise,
)

MOST_VALUES = 1_000
"""The covariance of the values is used up to so many, whose matrices of all groups then take up to 200 MB."""
LARGEST_RATIO = 1e6
"""Sum of the values' variances by the prior over that of the noise up to which traces of P are right to 1e-4."""


@dataclass(frozen=True, eq=False)
class ValueCovariance(AbstractRegression):
    """The values' covariance `V = Σ_g size_g² K_g + noise²` under the prior of the weights, beside the parameters.

    With G the columns of the parameters and Z those of the weights, `K_g = Σ_i Z_i Z_i^T / base_i` over the
    weights of group g, and `P = V^-1 - V^-1 G (G^T V^-1 G + Λ)^-1 G^T V^-1`::

        parameters = (G^T V^-1 G + Λ)^-1 G^T V^-1 y        weights_i = size² / base_i · Z_i^T P y
        determined_g = size_g² tr(P K_g)                    y - X x = noise² P y

    By Woodbury's identity posterior and evidence are those of `NormalEquations`. Source: Rasmussen and Williams,
    Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7 and 5.4.

    Attributes:
        design: the unknowns.
        rows: linearised values.
        X: weighted columns, the parameters first.
        y: weighted values.
        sensor: number of every value's sensor.
        group: of the rows that are held out together; -1 of values that are certain.
        prior: whose groups and base the matrices K are of; its sizes do not matter.
        K: of every group of weights, the lower triangle.
        sensors: how many values there are.
        groups: how many groups of rows there are.
    """

    design: Design
    rows: Rows
    X: Float64[Tensor, "values unknowns"]
    y: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]
    group: Int64[Tensor, " values"]
    prior: GaussianPrior
    K: Float64[Tensor, "groups pairs"]
    sensors: tuple[SensorCount, ...]
    groups: int

    @staticmethod
    def of(design: Design, rows: Rows) -> "ValueCovariance":
        """Make the matrices K of all rows."""
        parts = []
        for k, sensor in enumerate(rows.values):
            X = design.columns(sensor, slice(None))
            root = sensor.root[:, None]
            y = sensor.residual * root
            group = torch.full_like(sensor.row, -1) if sensor.certain else rows.group[sensor.row]
            parts.append(
                (
                    (X * root[..., None]).flatten(0, 1),
                    y.flatten(),
                    torch.full((y.numel(),), k, device=y.device),
                    group.repeat_interleave(sensor.components),
                )
            )
        X, y, number, group = (torch.cat(column) for column in zip(*parts, strict=True))
        prior = design.prior((1.0,) * design.classes)
        K = [_gram(X, prior, g, design.active) for g in range(prior.classes, len(prior.sizes))]
        return ValueCovariance(
            design, rows, X, y, number, group, prior, _stacked(K, y), rows.sensors, rows.groups
        )

    def select(self, design: Design) -> "ValueCovariance":
        """See `AbstractRegression.select`."""
        columns = self.design.indices(design.features)
        X, prior = self.X[:, columns], design.prior((1.0,) * design.classes)
        before = self.prior.group[columns]
        K = []
        for g in range(prior.classes, len(prior.sizes)):
            members = (prior.group == g).nonzero()[:, 0]
            other = int(before[members[0]]) if len(members) else prior.classes
            whole = 0 < len(members) == int((self.prior.group == other).sum())
            K.append(self.K[other - prior.classes] if whole else _gram(X, prior, g, design.active))
        return replace(self, design=design, X=X, prior=prior, K=_stacked(K, self.y))

    def without(self, groups: Int64[Tensor, " groups"]) -> "ValueCovariance":
        """See `AbstractRegression.without`."""
        kept = (~torch.isin(self.group, groups)).nonzero()[:, 0]
        sensor = self.sensor[kept]
        left, all_ = (
            torch.bincount(rows, minlength=len(self.sensors)).double() for rows in (sensor, self.sensor)
        )
        share = left / all_.clamp(min=1)
        counts = zip(self.sensors, share.tolist(), strict=True)
        return replace(
            self,
            X=self.X[kept],
            y=self.y[kept],
            sensor=sensor,
            group=self.group[kept],
            K=self.K[:, _places_of_pairs(kept)],
            sensors=tuple(replace(one, values=one.values * part) for one, part in counts),
        )

    def left_out(self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]) -> LeftOut:
        """See `AbstractRegression.left_out`; `noise² P` is `I - X C X^T`, and `noise² P y` the residual."""
        if self._is_ill(posterior.prior, posterior.noise):
            return self.normal_equations.left_out(posterior, folds)
        sigma = self.y.new_tensor(posterior.noise)[self.sensor]
        P = self._projection(posterior.prior, posterior.noise)[0].mul_(sigma).mul_(sigma[:, None])
        residual = P @ (self.y / sigma)
        parts = []
        for groups in folds:
            chosen = torch.cat([self._values_of_groups[k] for k in groups.tolist()]).sort().values
            parts.append(
                LeftOut.of(P[chosen][:, chosen], residual[chosen], self.sensor[chosen], self.sensors)
            )
        return LeftOut.joined(parts)

    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """See `AbstractRegression.solve`."""
        if self._is_ill(prior, noise):
            return self.normal_equations.solve(prior, noise)
        P, parameters, covariance, log_det = self._projection(prior, noise)
        active, precision = self.design.active, prior.precision
        variance = self.y.new_tensor(noise).square()[self.sensor]
        alpha = P @ self.y
        x = torch.cat([parameters, (self.X.t() @ alpha)[active:] / precision[active:]])
        square = prior.of_groups(x.square() * prior.base)
        held = torch.zeros_like(x)
        held[:active] = 1 - precision[:active] * covariance.diagonal()
        determined = prior.of_groups(held)
        traces = self.K @ (P.flatten().index_select(0, self._pairs) * self._counts)
        determined[prior.classes :] = prior.sizes[prior.classes :].square() * traces
        stated = precision[:active]
        evidence = float(self.y @ alpha) + log_det - float(stated[stated > 0].log().sum())
        evidence += log_noise(self.sensors, noise) - float(variance.log().sum())
        misfit = self._by_sensor((variance * alpha).square())
        used = self._by_sensor(1 - variance * P.diagonal())
        return Posterior(x, -0.5 * evidence, prior, noise, square, determined, misfit, used)

    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """See `AbstractRegression.covariance_root`; the weights follow the parameters by `-Λ^-1 X^T V^-1 G`."""
        if self._is_ill(posterior.prior, posterior.noise):
            return self.normal_equations.covariance_root(posterior)
        active, precision = self.design.active, posterior.prior.precision
        sigma = self.y.new_tensor(posterior.noise)[self.sensor]
        size = precision[active:].rsqrt()
        G, Z = self.X[:, :active] / sigma[:, None], self.X[:, active:] / sigma[:, None] * size
        V = Z @ Z.t()
        V.diagonal().add_(1.0)
        factor = torch.linalg.cholesky(V)
        inner = torch.linalg.solve_triangular(factor, G, upper=False)
        normal = inner.t() @ inner
        normal.diagonal().add_(precision[:active])
        scale, lower = factored(normal.clone)
        root = torch.linalg.solve_triangular(lower, torch.diag(scale), upper=False).t()
        follow = torch.linalg.solve_triangular(factor.t(), inner @ root, upper=True)
        directions = torch.cat([root, -size[:, None] * (Z.t() @ follow)])
        return CovarianceRoot(directions, FewValues(size, Z, factor))

    @cached_property
    def normal_equations(self) -> NormalEquations:
        """The same values as normal equations."""
        parts = [
            (self.X[rows], self.y[rows]) for rows in (self.sensor == k for k in range(len(self.sensors)))
        ]
        return NormalEquations(
            design=self.design,
            rows=self.rows,
            normal=torch.stack([X.t() @ X for X, _ in parts]),
            descent=torch.stack([X.t() @ y for X, y in parts]),
            square=tuple(float(y @ y) for _, y in parts),
            sensors=self.sensors,
        )

    def _is_ill(self, prior: GaussianPrior, noise: tuple[float, ...]) -> bool:
        """Whether the noise is so small beside the values that traces of P cancel; then normal equations are right."""
        diagonal = torch.arange(len(self.y)).add(1).cumsum(0) - 1
        trace = float(prior.sizes[prior.classes :].square() @ self.K[:, diagonal].sum(1))
        return trace > LARGEST_RATIO * min(noise) ** 2

    def _covariance(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Tensor:
        """The upper triangle of V."""
        V = self.y.new_zeros((len(self.y), len(self.y)))
        V.view(-1)[self._pairs] = prior.sizes[prior.classes :].square() @ self.K
        V.diagonal().add_(self.y.new_tensor(noise).square()[self.sensor])
        return V

    @cached_property
    def _pairs(self) -> Int64[Tensor, " pairs"]:
        """Where the values' pairs stand in a matrix that is stored row by row."""
        return _upper_triangle(len(self.y))

    @cached_property
    def _counts(self) -> Float64[Tensor, " pairs"]:
        """How often a pair stands in a symmetric matrix."""
        return torch.where(self._pairs % (len(self.y) + 1) == 0, 1.0, 2.0).to(self.y)

    @cached_property
    def _values_of_groups(self) -> tuple[Tensor, ...]:
        """Numbers of the values of every group of rows."""
        measured = (self.group >= 0).nonzero()[:, 0]
        group = self.group[measured]
        counts = torch.bincount(group, minlength=self.groups).tolist()
        return torch.split(measured[group.argsort(stable=True)], counts)

    def _projection(
        self, prior: GaussianPrior, noise: tuple[float, ...]
    ) -> tuple[Tensor, Tensor, Tensor, float]:
        """P, the parameters and their covariance, and `log |V| + log |G^T V^-1 G + Λ|`."""
        active = self.design.active
        factor = factored(lambda: self._covariance(prior, noise))
        log_det = log_determinant(*factor)
        inverse, G = inverted(*factor), self.X[:, :active]
        along = inverse @ G
        normal = G.t() @ along
        normal.diagonal().add_(prior.precision[:active])
        factor = factored(normal.clone)
        log_det += log_determinant(*factor)
        covariance = inverted(*factor)
        parameters = covariance @ (along.t() @ self.y)
        return inverse - along @ covariance @ along.t(), parameters, covariance, log_det

    def _by_sensor(self, values: Tensor) -> tuple[float, ...]:
        """Sums of the values of every sensor, those that are alike counted less."""
        sums = torch.zeros(len(self.sensors)).to(values).index_add(0, self.sensor, values)
        return tuple(sums.tolist())


def _gram(X: Tensor, prior: GaussianPrior, group: int, active: int) -> Tensor:
    """K of one group."""
    columns = (prior.group == group).nonzero()[:, 0]
    columns = columns[columns >= active]
    Z = X[:, columns] * prior.base[columns].rsqrt()
    return (Z @ Z.t()).flatten()[_upper_triangle(len(X))]


@lru_cache(maxsize=4)
def _upper_triangle(size: int) -> Int64[Tensor, " pairs"]:
    """Where the pairs of values stand in the upper triangle of a matrix that is stored row by row."""
    pairs: Tensor = torch.tril_indices(size, size)
    return pairs[1] * size + pairs[0]


def _places_of_pairs(values: Int64[Tensor, " values"]) -> Int64[Tensor, " pairs"]:
    """Where the pairs of some values, which ascend, stand among the pairs of all values."""
    first, second = values[torch.tril_indices(len(values), len(values))]
    pairs: Tensor = first * (first + 1) // 2 + second
    return pairs


def _stacked(K: list[Tensor], y: Tensor) -> Tensor:
    return torch.stack(K) if K else y.new_zeros((0, len(y) * (len(y) + 1) // 2))


def regression(design: Design, rows: Rows) -> AbstractRegression:
    """Normal equations, or the covariance of the values where there are few values and more unknowns."""
    values = sum(sensor.residual.numel() for sensor in rows.values)
    few = values <= min(MOST_VALUES, design.unknowns)
    return ValueCovariance.of(design, rows) if few else NormalEquations.of(design, rows)


def extended(before: AbstractRegression, design: Design, rows: Rows) -> AbstractRegression:
    """The regression of the same rows on a design that has some of the features, and a new one as its last."""
    return before.extended(design) if isinstance(before, NormalEquations) else regression(design, rows)
