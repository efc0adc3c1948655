"""Regression by the covariance of the values, for few values and many unknowns, and which form is the cheaper one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Int64
from torch import Tensor

from pisigma.calibration.hybrid.design import Design, Rows
from pisigma.calibration.hybrid.design_regression import AbstractDesignRegression
from pisigma.calibration.hybrid.normal_equations import NormalEquations
from pisigma.estimation.dual_regression import DualRegression, gram, places_of_pairs, stacked
from pisigma.estimation.left_out import LeftOut
from pisigma.estimation.regression import Posterior

MOST_VALUES = 1_000
"""The covariance of the values is used up to so many, whose matrices of all groups then take up to 200 MB."""


@dataclass(frozen=True, eq=False)
class ValueCovariance(DualRegression, AbstractDesignRegression):
    """The covariance of linearised rows' values under the prior of the weights of a design.

    Attributes:
        design: the unknowns.
        rows: linearised values.
        group: of the rows that are held out together; -1 of values that are certain.
    """

    design: Design
    rows: Rows
    group: Int64[Tensor, " values"]

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
        K = [gram(X, prior, g, design.active) for g in range(prior.classes, len(prior.sizes))]
        return ValueCovariance(
            X, y, number, prior, design.active, stacked(K, y), rows.sensors, design, rows, group
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
            K.append(self.K[other - prior.classes] if whole else gram(X, prior, g, design.active))
        return replace(self, design=design, X=X, prior=prior, K=stacked(K, self.y))

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
            K=self.K[:, places_of_pairs(kept)],
            sensors=tuple(replace(one, values=one.values * part) for one, part in counts),
        )

    def left_out(self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]) -> LeftOut:
        """See `AbstractRegression.left_out`; `noise² P` is `I - X C X^T`, and `noise² P y` the residual."""
        if self.is_ill(posterior.prior, posterior.noise):
            return self.primal.left_out(posterior, folds)
        sigma = self.y.new_tensor(posterior.noise)[self.sensor]
        P = self.projection(posterior.prior, posterior.noise)[0].mul_(sigma).mul_(sigma[:, None])
        residual = P @ (self.y / sigma)
        parts = []
        for groups in folds:
            chosen = torch.cat([self._values_of_groups[k] for k in groups.tolist()]).sort().values
            parts.append(
                LeftOut.of(P[chosen][:, chosen], residual[chosen], self.sensor[chosen], self.sensors)
            )
        return LeftOut.joined(parts)

    @cached_property
    def primal(self) -> NormalEquations:
        """The same values as normal equations."""
        return NormalEquations(*self.sums, self.sensors, self.design, self.rows)

    @cached_property
    def _values_of_groups(self) -> tuple[Tensor, ...]:
        """Numbers of the values of every group of rows."""
        measured = (self.group >= 0).nonzero()[:, 0]
        group = self.group[measured]
        counts = torch.bincount(group, minlength=self.rows.groups).tolist()
        return torch.split(measured[group.argsort(stable=True)], counts)


def regression(design: Design, rows: Rows) -> AbstractDesignRegression:
    """Normal equations, or the covariance of the values where there are few values and more unknowns."""
    values = sum(sensor.residual.numel() for sensor in rows.values)
    few = values <= min(MOST_VALUES, design.unknowns)
    return ValueCovariance.of(design, rows) if few else NormalEquations.of(design, rows)


def extended(before: AbstractDesignRegression, design: Design, rows: Rows) -> AbstractDesignRegression:
    """The regression of the same rows on a design that has some of the features, and a new one as its last."""
    return before.extended(design) if isinstance(before, NormalEquations) else regression(design, rows)
