"""Reference for the regressions of the hybrid: all columns in one matrix, with orthogonal factorisation."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pisigma.calibration.hybrid.design import AbstractDesignRegression, Design, LinearisedRows
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.held_out import HeldOutErrors
from pisigma.estimation.prior import GaussianPrior
from pisigma.estimation.regression import Posterior, SensorValueCount


@dataclass(frozen=True, eq=False)
class DenseRegression(AbstractDesignRegression):
    """All values and their columns.

    Attributes:
        X: weighted columns.
        y: weighted values.
        sensor: index of every value's sensor.
        group: group of the rows that are held out together; -1 for certain values.
        sensors: number of values of every sensor.
    """

    X: Tensor
    y: Tensor
    sensor: Tensor
    group: Tensor
    sensors: tuple[SensorValueCount, ...]

    @staticmethod
    def from_rows(design: Design, rows: LinearisedRows) -> "DenseRegression":
        """Return the regression of all weighted rows of all sensors."""
        parts = []
        for number, values in enumerate(rows.values):
            root = values.weight_root[:, None]
            group = torch.full_like(values.row, -1) if values.are_values_given else rows.group[values.row]
            parts.append(
                (
                    (design.columns(values, slice(None)) * root[..., None]).flatten(0, 1),
                    (values.residual * root).flatten(),
                    torch.full((values.residual.numel(),), number),
                    group.repeat_interleave(values.components),
                )
            )
        return DenseRegression(*map(torch.cat, zip(*parts, strict=True)), sensors=rows.sensors)

    @staticmethod
    def between(X: Sequence[Tensor], y: Sequence[Tensor], **known: tuple[bool, ...]) -> "DenseRegression":
        """Return the regression of given columns and values of several sensors, with one group per value."""
        sensor = torch.arange(len(y)).repeat_interleave(torch.tensor([len(values) for values in y]))
        none = (False,) * len(y)
        flags = zip(y, known.get("stated", none), known.get("exact", none), strict=True)
        counts = tuple(SensorValueCount(float(len(values)), stated, exact) for values, stated, exact in flags)
        return DenseRegression(
            torch.cat(list(X)), torch.cat(list(y)), sensor, torch.arange(len(sensor)), counts
        )

    def solve(self, prior: GaussianPrior, noise: tuple[float, ...]) -> Posterior:
        """Solve the least-squares problem of values and prior."""
        sigma, precision = self._sigma(noise), prior.precision
        R, x = self._factor(prior, noise)
        residual = self.y - self.X @ x
        fit = float((residual / sigma).square().sum() + (precision * x.square()).sum())
        log_det = 2 * float(R.diagonal().abs().log().sum()) - float(precision[precision > 0].log().sum())
        counts = zip(self.sensors, noise, strict=True)
        evidence = -0.5 * (fit + log_det + sum(2 * one.values * math.log(s) for one, s in counts))
        root = _inverse(R)
        covariance = root @ root.t()
        used = ((self.X @ covariance) * self.X).sum(1) / sigma.square()
        return Posterior(
            x=x,
            log_evidence=evidence,
            prior=prior,
            noise=noise,
            squared_unknowns=prior.sum_by_group(prior.unit_precision * x.square()),
            determined_unknowns=prior.sum_by_group(1 - precision * covariance.diagonal()),
            misfit=self._by_sensor(residual.square()),
            effective_parameters=self._by_sensor(used),
        )

    def covariance_root(self, posterior: Posterior) -> CovarianceRoot:
        """Compute the inverse of the triangular root of the precision of values and prior."""
        return CovarianceRoot(_inverse(self._factor(posterior.prior, posterior.noise)[0]))

    def select(self, design: Tensor) -> "DenseRegression":
        """Return the regression of some columns, by their indices."""
        return replace(self, X=self.X[:, design])

    def without_groups(self, groups: Tensor) -> "DenseRegression":
        """Return the regression of the values of the other groups."""
        kept = ~torch.isin(self.group, groups)
        share = [float(kept[self.sensor == k].double().mean()) for k in range(len(self.sensors))]
        counts = zip(self.sensors, share, strict=True)
        return DenseRegression(
            self.X[kept],
            self.y[kept],
            self.sensor[kept],
            self.group[kept],
            tuple(replace(one, values=one.values * part) for one, part in counts),
        )

    def held_out_errors(self, posterior: Posterior, folds: Sequence[Tensor]) -> HeldOutErrors:
        """Fit again without each fold; directions that the other values do not determine are fitted to the fold."""
        parts = []
        for groups in folds:
            chosen = torch.isin(self.group, groups)
            x, root, unknown = self.without_groups(groups)._solution(posterior.prior, posterior.noise)
            sigma, sensor = self._sigma(posterior.noise)[chosen], self.sensor[chosen]
            X, error = self.X[chosen] / sigma[:, None], (self.y - self.X @ x)[chosen] / sigma
            U, size, _ = torch.linalg.svd(X @ unknown, full_matrices=False)
            own = U[:, size > 1e-6]
            free = torch.eye(len(error)).double() - own @ own.t()
            count = len(error) - own.shape[1]
            error = free @ error * (len(error) / max(count, 1)) ** 0.5
            variance = (free @ (torch.eye(len(error)).double() + X @ root @ (X @ root).t()) @ free).diagonal()
            repetition = error.new_tensor([one.repeat_variance_factor for one in self.sensors])[sensor]
            spread = (1 + repetition * (variance - 1).clamp(min=0)).sqrt()
            parts.append(HeldOutErrors(error * repetition.sqrt(), spread, sensor))
        return HeldOutErrors.concatenate(parts)

    def _solution(self, prior: GaussianPrior, noise: Sequence[float]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the unknowns, the root of their covariance, and the undetermined directions."""
        whole, right = self._whole(prior, noise)
        scale = whole.norm(dim=0).clamp(min=1.0)
        U, size, V = torch.linalg.svd(whole / scale, full_matrices=False)
        known = size > 1e-9
        root = V[known].t() / size[known] / scale[:, None]
        return root @ (U[:, known].t() @ right), root, V[~known].t() / scale[:, None]

    def _whole(self, prior: GaussianPrior, noise: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Return values and prior as one least-squares problem."""
        sigma, precision = self._sigma(noise)[:, None], prior.precision
        whole = torch.cat([self.X / sigma, torch.diag(precision.sqrt())[precision > 0]])
        return whole, torch.cat([self.y / sigma[:, 0], torch.zeros(int((precision > 0).sum())).double()])

    def _factor(self, prior: GaussianPrior, noise: Sequence[float]) -> tuple[Tensor, Tensor]:
        """Return the triangular root of the precision of all unknowns, and their most probable values."""
        whole, right = self._whole(prior, noise)
        Q, R = torch.linalg.qr(whole)
        return R, torch.linalg.solve_triangular(R, (Q.t() @ right)[:, None], upper=True)[:, 0]

    def _sigma(self, noise: Sequence[float]) -> Tensor:
        return torch.tensor(noise, dtype=torch.float64)[self.sensor]

    def _by_sensor(self, values: Tensor) -> tuple[float, ...]:
        return tuple(float(values[self.sensor == k].sum()) for k in range(len(self.sensors)))


def _inverse(R: Tensor) -> Tensor:
    """Invert an upper triangular matrix."""
    return torch.linalg.solve_triangular(R, torch.eye(len(R)).double(), upper=True)
