"""Alternating least squares on product units, together with geometry and the unit of order 1."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.hybrid.alternating_products import AlternatingProducts, InputPairs, normalised
from pisigma.hybrid.design import Design, weighted_columns
from pisigma.hybrid.evidence import GaussianPrior, Posterior, Sums, maximise_evidence
from pisigma.hybrid.sensor_values import SensorValues
from pisigma.joint_correction.feature import AbstractFeature

ROUNDS = 12
"""Alternations; every factor of a unit of order 2 is solved six times."""
RENEWALS = (3, 7)
"""After these rounds noise and prior sizes of everything are estimated anew, unless that takes long."""
QUICK = 700
"""It takes long with more unknowns than these."""


@dataclass(frozen=True, eq=False)
class FittedProducts:
    """Product units as alternating least squares left them.

    Attributes:
        design: with the last free factors as its last features.
        posterior: of all its unknowns.
    """

    design: Design
    posterior: Posterior

    @property
    def units(self) -> AlternatingProducts:
        """The units with their factors."""
        units = self.design.features[-1]
        assert isinstance(units, AlternatingProducts)
        return units

    @property
    def factors(self) -> Float64[Tensor, "dof factors inputs"]:
        """All factors, the free ones as solved."""
        return self.units.solved(self.posterior.x[self.design.stretch(len(self.design.features) - 1)])


class ProductFit:
    """The rows, geometry and unit of order 1 that product units are fitted beside.

    In most rounds noise and prior sizes of geometry and unit of order 1 stay as they are; these unknowns are
    then taken out of the normal equations once (Schur complement), and a round costs little more than the product
    of their columns with those of the free factors.
    """

    def __init__(
        self,
        design: Design,
        values: Sequence[SensorValues],
        here: Float64[Tensor, " unknowns"],
        additive: Posterior,
        sums: Sums,
    ) -> None:
        """Prepare.

        Args:
            design: of geometry and the unit of order 1.
            values: weighted rows of every sensor.
            here: see `pisigma.hybrid.design.sum_up`.
            additive: posterior without product units.
            sums: normal equations of `design`.
        """
        self.design, self.values, self.sums = design, tuple(values), sums
        X, y = weighted_columns(design, values, here)
        self._X = [columns.flatten(0, 1) for columns in X]
        self._y = [target.flatten() for target in y]
        self._additive = additive

    @property
    def inputs(self) -> int:
        """Number of weights of a factor."""
        return InputPairs(self.design.problem.space.robot).inputs + 1

    def fit(self, orders: Sequence[int], final_iterations: int = 15) -> FittedProducts:
        """Fit product units, from a start in the pairs of inputs.

        Args:
            orders: number of factors of every unit.
            final_iterations: updates of all prior sizes and noise at the end; 0 leaves them.
        """
        self._reduce(self._additive)
        robot = self.design.problem.space.robot
        pairs = InputPairs(robot)
        weights, _, _ = self._reduced(pairs, self._first_prior(pairs), 8)
        factors = normalised(pairs.factors(weights, orders))
        prior = self._first_prior(AlternatingProducts(robot, orders, factors, 0))
        quick = self.design.unknowns <= QUICK
        for turn in range(ROUNDS - 1):
            units = AlternatingProducts(robot, orders, factors, turn)
            weights, prior, _ = self._reduced(units, prior, 3)
            if quick and turn in RENEWALS:
                whole = self._whole(units, prior, 5).posterior
                kept = whole.prior.select(torch.arange(self.design.unknowns))
                kept = replace(kept, sizes=kept.sizes[: len(self._prior.sizes)])
                self._reduce(replace(whole, prior=kept))
                weights = whole.x[self.design.unknowns :]
            factors = normalised(units.solved(weights))
        units = AlternatingProducts(robot, orders, factors, ROUNDS - 1)
        if final_iterations:
            return self._whole(units, prior, final_iterations)
        weights, prior, cross = self._reduced(units, prior, 3)
        return FittedProducts(self._with(units), self._completed(weights, prior, cross))

    def _reduce(self, base: Posterior) -> None:
        """Take geometry and unit of order 1 out, noise and prior sizes as in a posterior."""
        self._noise, self._prior = base.noise, base.prior
        size = self.design.unknowns
        precision = base.prior.precision[:size]
        weight = precision.new_tensor([sigma**-2 for sigma in base.noise])
        normal = torch.einsum("s,sij->ij", weight, self.sums.normal)
        used = self.sums.normal.flatten(1) @ base.covariance[:size, :size].flatten()
        self._count = sum(self.sums.count) - float(weight @ used)
        normal.diagonal().add_(precision)
        self._scale = normal.diagonal().clamp(min=1e-300).rsqrt()
        scaled = normal * self._scale * self._scale[:, None]
        scaled.diagonal().add_(1e-13)
        self._root = torch.linalg.cholesky(scaled)
        descent = weight @ self.sums.descent
        self._reduced_descent = self._solve_root((self._scale * descent)[:, None])[:, 0]
        square = sum(total / sigma**2 for total, sigma in zip(self.sums.square, base.noise, strict=True))
        self._square = max(square - float(self._reduced_descent.square().sum()), 0.0)

    def _reduced(
        self, features: AbstractFeature, prior: GaussianPrior, iterations: int
    ) -> tuple[Float64[Tensor, " weights"], GaussianPrior, Float64[Tensor, "unknowns weights"]]:
        """Weights of one more choice of features, their prior, and their columns' part in those taken out."""
        size = int(features.used.sum())
        normal = self._X[0].new_zeros((size, size))
        descent, cross = normal.new_zeros(size), normal.new_zeros((self.design.unknowns, size))
        for k, sigma in enumerate(self._noise):
            P = self._columns(features, k) / sigma
            normal.addmm_(P.t(), P)
            descent.addmv_(P.t(), self._y[k] / sigma)
            cross.addmm_(self._X[k].t(), P, alpha=1 / sigma)
        cross = self._solve_root(self._scale[:, None] * cross)
        normal -= cross.t() @ cross
        descent -= cross.t() @ self._reduced_descent
        sums = Sums(
            normal[None], descent[None], (self._square,), (max(self._count, 1.0),), (False,), (False,)
        )
        posterior = maximise_evidence(sums, prior, (1.0,), iterations)
        return posterior.x, posterior.prior, cross

    def _first_prior(self, features: AbstractFeature) -> GaussianPrior:
        """The prior of the weights of one more choice of features, to start from."""
        whole = self._with(features).prior((1.0,) * self._prior.classes)
        size = int(features.used.sum())
        first = int(whole.group[-size:].min())
        return GaussianPrior(whole.base[-size:], whole.group[-size:] - first, whole.sizes[first:], 0)

    def _completed(self, weights: Tensor, prior: GaussianPrior, cross: Tensor) -> Posterior:
        """All unknowns with the last weights; the covariance is left out."""
        rest = self._reduced_descent - cross @ weights
        base = self._scale * torch.linalg.solve_triangular(self._root.t(), rest[:, None], upper=True)[:, 0]
        x = torch.cat([base, weights])
        return Posterior(x, x.new_zeros((0, 0)), float("nan"), self._joined(prior), self._noise, 0)

    def _whole(self, features: AbstractFeature, prior: GaussianPrior, iterations: int) -> FittedProducts:
        """Solve for everything, with noise and all prior sizes."""
        posterior = maximise_evidence(self._extended(features), self._joined(prior), self._noise, iterations)
        return FittedProducts(self._with(features), posterior)

    def _joined(self, last: GaussianPrior) -> GaussianPrior:
        """The prior of everything."""
        first = self._prior
        return GaussianPrior(
            torch.cat([first.base, last.base]),
            torch.cat([first.group, last.group + len(first.sizes)]),
            torch.cat([first.sizes, last.sizes]),
            first.classes,
            first.fixed,
        )

    def _with(self, features: AbstractFeature) -> Design:
        return replace(self.design, features=(*self.design.features, features))

    def _columns(self, features: AbstractFeature, sensor: int) -> Float64[Tensor, "values weights"]:
        """Weighted columns of one more choice of features."""
        values = self.values[sensor]
        columns = values.feature_columns(features, self.design.problem.state, slice(None))
        return (columns * values.root[:, None, None]).flatten(0, 1)

    def _solve_root(self, right: Tensor) -> Tensor:
        solved: Tensor = torch.linalg.solve_triangular(self._root, right, upper=False)
        return solved

    def _extended(self, features: AbstractFeature) -> Sums:
        """Normal equations with the columns of more features behind the others."""
        old = self.design.unknowns
        parts, descents = [], []
        for k in range(len(self.values)):
            P = self._columns(features, k)
            normal = P.new_empty((old + P.shape[1], old + P.shape[1]))
            normal[:old, :old] = self.sums.normal[k]
            normal[:old, old:] = self._X[k].t() @ P
            normal[old:, :old] = normal[:old, old:].t()
            normal[old:, old:] = P.t() @ P
            parts.append(normal)
            descents.append(torch.cat([self.sums.descent[k], P.t() @ self._y[k]]))
        return replace(self.sums, normal=torch.stack(parts), descent=torch.stack(descents))
