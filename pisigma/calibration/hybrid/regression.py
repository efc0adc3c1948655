"""Regression of values on the unknowns of a design, by normal equations or, for few values, by their covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.hybrid.design import AbstractDesignRegression, Design, LinearisedRows, chunks
from pisigma.calibration.hybrid.sensor_values import SensorValues
from pisigma.estimation.cholesky import BLOCK, release_free_memory, row_blocks
from pisigma.estimation.dual_regression import DualRegression, group_gram, pair_indices, stack_groups
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.primal_regression import PrimalRegression, SolvedRegression
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import Posterior, SensorValueCount
from pisigma.joint_correction.feature import AbstractFeature

_NARROW = 64
"""Number of rows whose columns are in memory at a time, if only products with some columns are needed."""


@dataclass(frozen=True, eq=False)
class NormalEquations(PrimalRegression, AbstractDesignRegression):
    """Normal equations of linearised rows for the unknowns of a design.

    Attributes:
        design: the unknowns.
        rows: linearised values.
    """

    design: Design
    rows: LinearisedRows

    @staticmethod
    def from_rows(design: Design, rows: LinearisedRows) -> "NormalEquations":
        """Return the normal equations of the rows, summed chunk by chunk.

        The columns of a joint's weights are its features times the derivative with respect to its value, `J_j f_jm`.
        Therefore, for two joints, `X_j^T X_i = f_j^T diag(J_j^T J_i) f_i`: the components of a value are summed before
        the products.
        """
        size = design.unknowns
        release_free_memory(size)
        normal = design.problem.q.new_empty((len(rows.values), size, size))
        descent, square = normal.new_empty((len(rows.values), size)), []
        for k, sensor in enumerate(rows.values):
            square.append(_add_sums(design, sensor, normal[k], descent[k]))
        return NormalEquations(normal, descent, tuple(square), rows.sensors, design, rows)

    def select(self, design: Design) -> "NormalEquations":
        """Return the regression for a subset of the features; see `AbstractDesignRegression.select`."""
        if design.unknowns == self.design.unknowns and design.features == self.design.features:
            return self
        release_free_memory(design.unknowns)
        columns = self.design.indices(design.features)
        normal = self.normal.new_empty((len(self.normal), len(columns), len(columns)))
        for whole, part in zip(self.normal, normal, strict=True):
            _copy_chosen(whole, columns, part)
        return replace(self, design=design, normal=normal, descent=self.descent[:, columns])

    def with_feature(self, design: Design) -> "NormalEquations":
        """Return the equations for a design with a subset of the features and a new last feature.

        Existing sums are copied.
        """
        self.latest_solution.clear()
        release_free_memory(design.unknowns)
        before = self.design.indices(design.features[:-1])
        first, new = len(before), slice(len(before), None)
        normal = self.normal.new_empty((len(self.normal), design.unknowns, design.unknowns))
        descent = torch.cat(
            [self.descent[:, before], normal.new_zeros((len(normal), len(normal[0]) - first))], 1
        )
        for N, b, whole, sensor in zip(normal, descent, self.normal, self.rows.values, strict=True):
            _copy_chosen(whole, before, N[:first, :first])
            N[new] = 0.0
            for rows in chunks(len(sensor.row), _NARROW):
                root = sensor.weight_root[rows, None]
                X = (design.columns(sensor, rows) * root[..., None]).flatten(0, 1)
                N[new].addmm_(X[:, new].t(), X)
                b[new].addmv_(X[:, new].t(), (sensor.residual[rows] * root).flatten())
            N[:first, new] = N[new, :first].t()
        return replace(self, design=design, normal=normal, descent=descent)

    def without_groups(self, groups: Int64[Tensor, " groups"]) -> "NormalEquations":
        """Return the regression without groups of rows; see `AbstractDesignRegression.without_groups`."""
        other = NormalEquations.from_rows(self.design, self.rows.held_out_rows(groups))
        counts = zip(self.sensors, other.sensors, strict=True)
        return replace(
            self,
            normal=torch.sub(self.normal, other.normal, out=other.normal),
            descent=self.descent - other.descent,
            squared_values=tuple(
                a - b for a, b in zip(self.squared_values, other.squared_values, strict=True)
            ),
            sensors=tuple(replace(a, values=a.values - b.values) for a, b in counts),
        )

    def held_out_errors(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]
    ) -> HeldOutErrors:
        """Return the errors of held-out folds; see `AbstractDesignRegression.held_out_errors`."""
        solved = self.solved_with(posterior.prior, posterior.noise)
        return HeldOutErrors.concatenate([self._held_out_errors(groups, solved) for groups in folds])

    def _held_out_errors(self, groups: Int64[Tensor, " groups"], solved: SolvedRegression) -> HeldOutErrors:
        """Return the errors of one fold, predicted without it."""
        release_free_memory(len(solved.x))
        test, x = self.rows.held_out_rows(groups).values, solved.x
        whitened = x.new_empty((sum(sensor.residual.numel() for sensor in test), len(x)))
        r, number, first = [], [], 0
        for k, (sensor, sigma) in enumerate(zip(test, solved.noise, strict=True)):
            root = sensor.weight_root[:, None] / sigma
            columns = self.design.columns(sensor, slice(None))
            r.append(((sensor.residual - columns @ x) * root).flatten())
            number.append(torch.full(r[-1].shape, k, device=x.device))
            block = whitened[first : first + len(r[-1])].view(columns.shape)
            torch.mul(columns, root[..., None], out=block).mul_(solved.scale)
            first += len(r[-1])
            # The columns are the largest arrays, so only one copy of them is kept.
            del columns
        # M = I - X C X^T with C = L^-T L^-1: the inverse factor is lower triangular, so each block of its rows only
        # needs the columns up to its end.
        M = torch.eye(first, dtype=x.dtype, device=x.device)
        for rows in row_blocks(len(x), BLOCK):
            S = solved.inverse_factor[rows, : rows.stop] @ whitened[:, : rows.stop].t()
            M.addmm_(S.t(), S, alpha=-1)
        return HeldOutErrors.from_fit(M, torch.cat(r), torch.cat(number), self.sensors)

    def evidence_gain(
        self, posterior: Posterior, design: Design, features: AbstractFeature
    ) -> tuple[float, Tensor | None]:
        """Return the gain of log evidence by features; see `AbstractDesignRegression.evidence_gain`.

        The other unknowns are eliminated from the normal equations (Schur complement), so that only the weights of the
        features remain.
        """
        columns = self.design.indices((*design.features, features))
        old, new = columns[: design.unknowns], columns[design.unknowns :]
        solved = self.select(design).solved_with(posterior.prior, posterior.noise)
        normal = sum(N[new] * sigma**-2 for N, sigma in zip(self.normal, posterior.noise, strict=True))
        descent = sum(b * sigma**-2 for b, sigma in zip(self.descent, posterior.noise, strict=True))
        square = sum(
            total / sigma**2 for total, sigma in zip(self.squared_values, posterior.noise, strict=True)
        )
        # Schur complement: the remainder of the new columns after fitting the old columns.
        cross = normal[:, old]
        root = solved.inverse_factor @ (cross * solved.scale).t()
        rest = square - float(descent[old] @ solved.x)
        # The remaining squares have unit noise, because sensors were already weighted by their noise.
        alone = PrimalRegression(
            normal=(normal[:, new] - root.t() @ root)[None],
            descent=(descent[new] - cross @ solved.x)[None],
            squared_values=(rest,),
            sensors=(SensorValueCount(float(len(new)), False, True),),
        )
        whole = Design(design.problem, (*design.features, features)).prior((1.0,) * design.class_count)
        first = int(whole.group[design.unknowns :].min())
        prior = GaussianPrior(
            whole.unit_precision[design.unknowns :],
            whole.group[design.unknowns :] - first,
            whole.group_scales[first:],
            0,
        )
        best = alone.maximise_evidence(prior, (1.0,))
        return best.log_evidence + rest / 2, best.prior.group_scales


def _add_sums(design: Design, sensor: SensorValues, N: Tensor, b: Tensor) -> float:
    """Add the normal matrix and right-hand side of a sensor's values in place; return the sum of the squared values."""
    active, dof = design.active_count, sensor.joint_derivatives.shape[-1]
    count = sum(chosen.column_count for chosen in design.features)
    size = active + dof * count
    normal = sensor.weight_root.new_zeros((size, size))
    descent, square, weight = normal.new_zeros(size), 0.0, sensor.weight_root.square()
    for rows in chunks(len(sensor.row)):
        G, y, w = sensor.geometry_derivatives[rows], sensor.residual[rows], weight[rows]
        Gw = G * w[:, None, None]
        normal[:active, :active] += Gw.flatten(0, 1).t() @ G.flatten(0, 1)
        descent[:active] += Gw.flatten(0, 1).t() @ y.flatten()
        square += float((y.square() * w[:, None]).sum())
        sides = [
            (_feature_columns(design, row[rows]), joints[rows])
            for row, joints in sensor.row_derivatives
            if count
        ]
        for f, J in sides:
            # A weight moves joint j by the feature f, so its column is f · J_j: all blocks are products of f and J.
            Jw = J * w[:, None, None]
            along, pull = Jw.mT @ G, torch.einsum("rcj,rc->rj", Jw, y)
            for g, other in sides:
                shared = Jw.mT @ other
                for j in range(dof):  # blocks from the diagonal on; the matrix is symmetric
                    first = active + j * count
                    right = (g[:, j:] * shared[:, j, j:, None]).flatten(1)
                    normal[first : first + count, first:].addmm_(f[:, j].t(), right)
            for j in range(dof):
                block = slice(active + j * count, active + (j + 1) * count)
                normal[:active, block].addmm_(along[:, j].t(), f[:, j])
                descent[block].addmv_(f[:, j].t(), pull[:, j])
    # Not every joint uses every feature; unused weights are computed with the blocks and omitted here.
    order = torch.cat([torch.arange(active), active + _places(design, dof, count)])
    for rows in chunks(size):
        corner = normal[rows, rows]
        corner.copy_(corner.triu() + corner.triu(1).t())
        normal[rows.stop :, rows] = normal[rows, rows.stop :].t()
    _copy_chosen(normal, order, N)
    b.copy_(descent[order])
    return square


def _copy_chosen(matrix: Tensor, chosen: Int64[Tensor, " chosen"], to: Tensor) -> None:
    """Copy chosen rows and columns of a matrix, without a third matrix in memory."""
    for rows in chunks(len(chosen)):
        torch.index_select(matrix[chosen[rows]], 1, chosen, out=to[rows])


def _feature_columns(design: Design, row: Tensor) -> Float64[Tensor, "rows dof columns"]:
    """Compute the columns of all features at rows of the problem, including columns that a joint does not use."""
    state = design.problem.state[row]
    return torch.cat([chosen.columns_of_rows(state) for chosen in design.features], -1)


def _places(design: Design, dof: int, count: int) -> Int64[Tensor, " weights"]:
    """Return the positions of the used weights in an order by joint, feature and column."""
    first, places = 0, [torch.zeros(0, dtype=torch.int64)]
    for chosen in design.features:
        own = torch.arange(dof)[:, None] * count + first + torch.arange(chosen.column_count)
        places.append(own[chosen.used])
        first += chosen.column_count
    return torch.cat(places)


MAX_VALUES = 1_000
"""Number of values up to which their covariance is used; the matrices of all groups then take up to 200 MB."""


@dataclass(frozen=True, eq=False)
class ValueCovariance(DualRegression, AbstractDesignRegression):
    """Covariance of the values of linearised rows under the prior of the weights of a design.

    Attributes:
        design: the unknowns.
        rows: linearised values.
        group: group of the row of every value, see `Rows.group`; -1 for given values.
    """

    design: Design
    rows: LinearisedRows
    group: Int64[Tensor, " values"]

    @staticmethod
    def from_rows(design: Design, rows: LinearisedRows) -> "ValueCovariance":
        """Return the matrices K of all rows."""
        parts = []
        for k, sensor in enumerate(rows.values):
            X = design.columns(sensor, slice(None))
            root = sensor.weight_root[:, None]
            y = sensor.residual * root
            group = torch.full_like(sensor.row, -1) if sensor.are_values_given else rows.group[sensor.row]
            parts.append(
                (
                    (X * root[..., None]).flatten(0, 1),
                    y.flatten(),
                    torch.full((y.numel(),), k, device=y.device),
                    group.repeat_interleave(sensor.components),
                )
            )
        X, y, number, group = (torch.cat(column) for column in zip(*parts, strict=True))
        prior = design.prior((1.0,) * design.class_count)
        K = [
            group_gram(X, prior, g, design.active_count)
            for g in range(prior.geometric_class_count, len(prior.group_scales))
        ]
        return ValueCovariance(
            X, y, number, prior, design.active_count, stack_groups(K, y), rows.sensors, design, rows, group
        )

    def select(self, design: Design) -> "ValueCovariance":
        """Return the regression for a subset of the features; see `AbstractDesignRegression.select`."""
        columns = self.design.indices(design.features)
        X, prior = self.X[:, columns], design.prior((1.0,) * design.class_count)
        before = self.prior.group[columns]
        K = []
        for g in range(prior.geometric_class_count, len(prior.group_scales)):
            members = (prior.group == g).nonzero()[:, 0]
            other = int(before[members[0]]) if len(members) else prior.geometric_class_count
            whole = 0 < len(members) == int((self.prior.group == other).sum())
            K.append(
                self.K[other - prior.geometric_class_count]
                if whole
                else group_gram(X, prior, g, design.active_count)
            )
        return replace(self, design=design, X=X, prior=prior, K=stack_groups(K, self.y))

    def without_groups(self, groups: Int64[Tensor, " groups"]) -> "ValueCovariance":
        """Return the regression without groups of rows; see `AbstractDesignRegression.without_groups`."""
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
            K=self.K[:, pair_indices(kept)],
            sensors=tuple(replace(one, values=one.values * part) for one, part in counts),
        )

    def held_out_errors(
        self, posterior: Posterior, folds: Sequence[Int64[Tensor, " _groups"]]
    ) -> HeldOutErrors:
        """Return the errors of held-out folds; the residual is `noise² P y` with `noise² P = I - X C X^T`."""
        if self.is_ill_conditioned(posterior.prior, posterior.noise):
            return self.normal_equations.held_out_errors(posterior, folds)
        sigma = self.y.new_tensor(posterior.noise)[self.sensor]
        P = self.projection(posterior.prior, posterior.noise)[0].mul_(sigma).mul_(sigma[:, None])
        residual = P @ (self.y / sigma)
        parts = []
        for groups in folds:
            chosen = torch.cat([self._values_of_groups[k] for k in groups.tolist()]).sort().values
            parts.append(
                HeldOutErrors.from_fit(
                    P[chosen][:, chosen], residual[chosen], self.sensor[chosen], self.sensors
                )
            )
        return HeldOutErrors.concatenate(parts)

    @cached_property
    def normal_equations(self) -> NormalEquations:
        """Return the normal equations of the same values."""
        return NormalEquations(*self.normal_equation_sums, self.sensors, self.design, self.rows)

    @cached_property
    def _values_of_groups(self) -> tuple[Tensor, ...]:
        """Indices of the values of every group of rows."""
        measured = (self.group >= 0).nonzero()[:, 0]
        group = self.group[measured]
        counts = torch.bincount(group, minlength=self.rows.groups).tolist()
        return torch.split(measured[group.argsort(stable=True)], counts)


def build_regression(design: Design, rows: LinearisedRows) -> AbstractDesignRegression:
    """Return normal equations, or the covariance of the values if they are few and fewer than the unknowns."""
    values = sum(sensor.residual.numel() for sensor in rows.values)
    few = values <= min(MAX_VALUES, design.unknowns)
    return ValueCovariance.from_rows(design, rows) if few else NormalEquations.from_rows(design, rows)


def extend_regression(
    regression: AbstractDesignRegression, design: Design, rows: LinearisedRows
) -> AbstractDesignRegression:
    """Return the regression of the same rows on a design with a subset of the features and a new last feature."""
    return (
        regression.with_feature(design)
        if isinstance(regression, NormalEquations)
        else build_regression(design, rows)
    )
