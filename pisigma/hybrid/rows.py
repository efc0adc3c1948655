"""Linearised rows that a hybrid is fitted to, and how well it predicts them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.hybrid.design import Design
from pisigma.hybrid.evidence import Posterior
from pisigma.hybrid.sensor_values import SensorValues
from pisigma.identification.problem.loss import AbstractLoss, SquaredLoss
from pisigma.identification.problem.problem import CalibrationProblem


@dataclass(frozen=True, eq=False)
class Rows:
    """Values of all sensors, linearised at one point.

    Attributes:
        problem: free parameters and joint values.
        values: per sensor, weighted, repeats of a pose as one row.
        here: free parameters counted from nominal where the values were linearised.
        configuration: number of every row's joint values; rows of one are never parted.
        weights: of the joint correction that was in force there; None for none.
    """

    problem: CalibrationProblem
    values: tuple[SensorValues, ...]
    here: Float64[Tensor, " active"]
    configuration: Int64[Tensor, " rows"]
    weights: Float64[Tensor, " weights"] | None = None

    @property
    def configurations(self) -> int:
        """How many different joint values there are."""
        return int(self.configuration.max()) + 1

    def of(self, chosen: Bool[Tensor, " configurations"]) -> "Rows":
        """The rows of some configurations."""
        kept = tuple(sensor.select(chosen[self.configuration[sensor.row]]) for sensor in self.values)
        return replace(self, values=kept)

    def start(self, design: Design) -> Float64[Tensor, " unknowns"]:
        """All unknowns of a design where the values were linearised."""
        weights = self.weights
        if weights is None:
            weights = self.here.new_zeros(design.unknowns - len(self.here))
        return torch.cat([self.here, weights])

    def sample(self, most: int) -> "Rows":
        """At most so many configurations, drawn at random but always the same."""
        if self.configurations <= most:
            return self
        order = torch.randperm(self.configurations, generator=torch.Generator().manual_seed(0))
        mask = torch.zeros(self.configurations, dtype=torch.bool)
        mask[order[:most]] = True
        return self.of(mask.to(self.configuration.device))

    def left(self, design: Design, posterior: Posterior, noise: Sequence[float]) -> Float64[Tensor, " found"]:
        """Sum of squared residuals over variances of every configuration, under a posterior."""
        total = posterior.x.new_zeros(self.configurations)
        change = self.start(design) - posterior.x
        for sensor, sigma in zip(self.values, noise, strict=True):
            if sensor.certain or not len(sensor.row):
                continue
            residual = sensor.residual + design.columns(sensor, slice(None)) @ change
            square = (residual * sensor.root[:, None] / sigma).square().sum(1)
            total.index_add_(0, self.configuration[sensor.row], square)
        return total


def weigh(
    values: Sequence[SensorValues],
    design: Design,
    change: Float64[Tensor, " unknowns"],
    used: Sequence[float],
    loss: AbstractLoss,
) -> tuple[Float64[Tensor, " seen"], ...]:
    """Weights of all rows of every sensor by their distance from a prediction.

    Args:
        values: not weighted.
        design: the unknowns.
        change: unknowns where the values were linearised, minus those of the prediction.
        used: values that the unknowns use up, per sensor.
        loss: how far-off rows count; its scale is automatic.
    """
    found = []
    for sensor, taken in zip(values, used, strict=True):
        residual = torch.cat(
            [
                sensor.residual[rows] + design.columns(sensor, rows) @ change
                for rows in (slice(k, k + 1024) for k in range(0, len(sensor.row), 1024))
            ]
        )
        distance = residual.norm(dim=1) * sensor.root
        if sensor.certain or isinstance(loss, SquaredLoss):
            found.append(torch.ones_like(distance))
            continue
        scale = max(loss.scale(distance, sensor.components, taken), 1e-10)
        found.append(loss.weight(distance / scale, sensor.components))
    return tuple(found)
