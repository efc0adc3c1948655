"""Losses, which weight a row in least squares according to its distance from the prediction in standard deviations."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

MEDIAN_DISTANCE = {1: 0.674490, 2: 1.177410, 3: 1.538172, 6: 2.312600}
"""Median length of a standard normal vector by its number of components."""
DISTANCE_99 = {1: 2.575829, 2: 3.034854, 3: 3.368214, 6: 4.100231}
"""99 % quantile of the length of a standard normal vector by its number of components."""

HAMPEL_VARIANCE = {1: 0.990933, 2: 0.995409, 3: 0.996914, 6: 0.998435}
"""Weighted variance of standard normal noise under Hampel's weights: `E[w d²] / (components · E[w])`."""


Scalar = Float[Tensor, ""] | float


class AbstractLoss(ABC):
    """Cost of a row as a function of its relative length, the length of its residual in standard deviations.

    `components` is the number of values of a row.
    """

    @abstractmethod
    def cost(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return the cost of every row, the squared length for small distances."""

    @abstractmethod
    def weight(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return the least-squares weight of every row: half the derivative of the cost divided by the length."""

    @abstractmethod
    def scale(
        self, residual_length: Float[Tensor, " rows"], components: int, effective_parameters: Scalar
    ) -> Float[Tensor, ""]:
        """Estimate the standard deviation of one value without an initial scale.

        Args:
            residual_length: lengths of the residuals of the measured rows, in the sensor's unit.
            components: number of values per row.
            effective_parameters: effective number of values that the estimated parameters absorb.
        """

    @abstractmethod
    def sigma(
        self,
        residual_length: Float[Tensor, " rows"],
        components: int,
        effective_parameters: Scalar,
        scale: Scalar,
    ) -> Float[Tensor, ""]:
        """Estimate the standard deviation of one value from all good rows.

        Args:
            residual_length: lengths of the residuals of the measured rows, in the sensor's unit.
            components: number of values per row.
            effective_parameters: effective number of values that the estimated parameters absorb.
            scale: initial estimate, to distinguish good rows from outliers.
        """


@dataclass(frozen=True)
class SquaredLoss(AbstractLoss):
    """Plain least squares."""

    def cost(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return the squared length."""
        return relative_length.square()

    def weight(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return 1 for every row."""
        return torch.ones_like(relative_length)

    def scale(
        self, residual_length: Float[Tensor, " rows"], components: int, effective_parameters: Scalar
    ) -> Float[Tensor, ""]:
        """Return the root mean square of the distances, corrected for the parameters."""
        return self.sigma(residual_length, components, effective_parameters, 1.0)

    def sigma(
        self,
        residual_length: Float[Tensor, " rows"],
        components: int,
        effective_parameters: Scalar,
        scale: Scalar,
    ) -> Float[Tensor, ""]:
        """Return the root mean square of the distances, corrected for the parameters."""
        return (
            residual_length.square().sum() / _left(residual_length, components, effective_parameters)
        ).sqrt()


@dataclass(frozen=True)
class HampelLoss(AbstractLoss):
    """Least squares up to the 99 % quantile of normal noise, with weights that decrease to 0 at three times that.

    Hampel's three-part function (Hampel et al. 1986, section 2.6) with corners at 1, 1.5 and 3 times the quantile:
    good rows have the weight 1, so normal noise is treated as in least squares; gross outliers have the weight 0.
    The scale is the median of the distances, so it needs no threshold in metres and tolerates nearly half of the rows
    being wrong.
    """

    def cost(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return the cost of every row: a square, line, parabola or constant, depending on the length."""
        a = DISTANCE_99[components]
        b, c = 1.5 * a, 3 * a
        straight, bent = relative_length.clamp(a, c).sub_(a), relative_length.clamp(b, c).sub_(b)
        cost: Tensor = relative_length.clamp(max=a).square_().add_(straight, alpha=2 * a)
        return cost.addcmul_(bent, bent, value=-a / (c - b))

    def weight(self, relative_length: Float[Tensor, " rows"], components: int) -> Float[Tensor, " rows"]:
        """Return the weight of every row: 1, a / length, a decreasing function or 0, depending on the length."""
        a = DISTANCE_99[components]
        b, c = 1.5 * a, 3 * a
        falling: Tensor = torch.rsub(relative_length, c).div_(c - b).clamp_(0, 1)
        return falling.mul_(a).div_(relative_length.clamp(min=a))

    def scale(
        self, residual_length: Float[Tensor, " rows"], components: int, effective_parameters: Scalar
    ) -> Float[Tensor, ""]:
        """Return the median length divided by that of a standard normal vector, corrected for the parameters."""
        factor = math.sqrt(len(residual_length) * components) / MEDIAN_DISTANCE[components]
        return (
            residual_length.median()
            * _left(residual_length, components, effective_parameters).rsqrt()
            * factor
        )

    def sigma(
        self,
        residual_length: Float[Tensor, " rows"],
        components: int,
        effective_parameters: Scalar,
        scale: Scalar,
    ) -> Float[Tensor, ""]:
        """Return the weighted root mean square, corrected for the parameters and the weights."""
        weight = self.weight(residual_length / scale, components)
        left = (weight.sum() * components - effective_parameters).clamp(min=1.0)
        return ((weight * residual_length.square()).sum() / left / HAMPEL_VARIANCE[components]).sqrt()


def _left(residual_length: Float[Tensor, " rows"], components: int, used: Scalar) -> Float[Tensor, ""]:
    """Return the degrees of freedom that the estimated parameters leave, at least one."""
    values = len(residual_length) * components
    if isinstance(used, float | int):
        return residual_length.new_tensor(max(values - used, 1.0))
    return torch.rsub(used, values).clamp(min=1.0)
