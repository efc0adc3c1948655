"""Losses: how much a row counts, given its distance from the prediction in standard deviations."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

MEDIAN_DISTANCE = {1: 0.674490, 2: 1.177410, 3: 1.538172, 6: 2.312600}
"""Median of the length of a standard normal vector with so many components."""
DISTANCE_99 = {1: 2.575829, 2: 3.034854, 3: 3.368214, 6: 4.100231}
"""Its 99 % quantile."""

HAMPEL_VARIANCE = {1: 0.990933, 2: 0.995409, 3: 0.996914, 6: 0.998435}
"""Weighted variance of standard normal noise under Hampel's weights: `E[w d²] / (components · E[w])`."""


Figure = Float[Tensor, ""] | float


class AbstractLoss(ABC):
    """What a row's distance (in standard deviations) costs; `components` is how many values the row has."""

    @abstractmethod
    def cost(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Cost of every row; the distance's square for small distances."""

    @abstractmethod
    def weight(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Weight of every row in least squares: half the derivative of the cost over the distance."""

    @abstractmethod
    def scale(self, distance: Float[Tensor, " rows"], components: int, used: Figure) -> Float[Tensor, ""]:
        """Standard deviation of one value while the scale is still unknown.

        Args:
            distance: distances of the rows that were measured, in the sensor's unit.
            components: values a row.
            used: how many values the estimated parameters use up.
        """

    @abstractmethod
    def deviation(
        self, distance: Float[Tensor, " rows"], components: int, used: Figure, scale: Figure
    ) -> Float[Tensor, ""]:
        """Standard deviation of one value, from all good rows.

        Args:
            distance: distances of the rows that were measured, in the sensor's unit.
            components: values a row.
            used: how many values the estimated parameters use up.
            scale: about what it is, to distinguish the good rows.
        """


@dataclass(frozen=True)
class SquaredLoss(AbstractLoss):
    """Plain least squares."""

    def cost(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """The square."""
        return distance.square()

    def weight(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """One."""
        return torch.ones_like(distance)

    def scale(self, distance: Float[Tensor, " rows"], components: int, used: Figure) -> Float[Tensor, ""]:
        """Root mean square, corrected for the parameters."""
        return self.deviation(distance, components, used, 1.0)

    def deviation(
        self, distance: Float[Tensor, " rows"], components: int, used: Figure, scale: Figure
    ) -> Float[Tensor, ""]:
        """Root mean square, corrected for the parameters."""
        return (distance.square().sum() / _left(distance, components, used)).sqrt()


@dataclass(frozen=True)
class HampelLoss(AbstractLoss):
    """Least squares up to the 99 % quantile of normal noise, then less and less, at three times that nothing.

    Hampel's three-part function (Hampel et al. 1986, section 2.6) with corners at 1, 1.5 and 3 times the quantile:
    good rows keep the weight one, so normal noise is treated as by least squares; rows far off do not count
    at all. The scale is the median of the distances, so it needs no threshold in metres and stands up to
    nearly half of the rows being wrong.
    """

    def cost(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Square, line, parabola, constant."""
        a = DISTANCE_99[components]
        b, c = 1.5 * a, 3 * a
        straight, bent = distance.clamp(a, c).sub_(a), distance.clamp(b, c).sub_(b)
        cost: Tensor = distance.clamp(max=a).square_().add_(straight, alpha=2 * a)
        return cost.addcmul_(bent, bent, value=-a / (c - b))

    def weight(self, distance: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """One, a / distance, falling, zero."""
        a = DISTANCE_99[components]
        b, c = 1.5 * a, 3 * a
        falling: Tensor = torch.rsub(distance, c).div_(c - b).clamp_(0, 1)
        return falling.mul_(a).div_(distance.clamp(min=a))

    def scale(self, distance: Float[Tensor, " rows"], components: int, used: Figure) -> Float[Tensor, ""]:
        """Median over that of a standard normal vector, corrected for the parameters."""
        factor = math.sqrt(len(distance) * components) / MEDIAN_DISTANCE[components]
        return distance.median() * _left(distance, components, used).rsqrt() * factor

    def deviation(
        self, distance: Float[Tensor, " rows"], components: int, used: Figure, scale: Figure
    ) -> Float[Tensor, ""]:
        """Weighted root mean square, less what the parameters used up and what the weights take off."""
        weight = self.weight(distance / scale, components)
        left = (weight.sum() * components - used).clamp(min=1.0)
        return ((weight * distance.square()).sum() / left / HAMPEL_VARIANCE[components]).sqrt()


def _left(distance: Float[Tensor, " rows"], components: int, used: Figure) -> Float[Tensor, ""]:
    """How many values the estimated parameters leave over, at least one."""
    values = len(distance) * components
    if isinstance(used, float | int):
        return distance.new_tensor(max(values - used, 1.0))
    return torch.rsub(used, values).clamp(min=1.0)
