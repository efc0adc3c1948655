"""Held-out errors of a linear fit: values, or the values of one row, are predicted from all others."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.estimation.cholesky import orthonormal_columns
from pisigma.estimation.regression import SensorValueCount

SINGULAR = 1e-6
"""Share of a held-out value's variance below which the other values do not determine it."""
MAX_SCALE = 1e4
"""Largest factor on variances."""


@dataclass(frozen=True, eq=False)
class HeldOutErrors:
    """Errors of held-out values, in standard deviations of the noise.

    Attributes:
        error: measured minus predicted value.
        predicted_sigma: predicted standard deviation of the error, from parameters and noise.
        sensor: index of every value's sensor.
    """

    error: Float64[Tensor, " values"]
    predicted_sigma: Float64[Tensor, " values"]
    sensor: Int64[Tensor, " values"]

    @staticmethod
    def from_fit(
        M: Float64[Tensor, "values values"],
        residual: Float64[Tensor, " values"],
        sensor: Int64[Tensor, " values"],
        sensor_counts: Sequence[SensorValueCount],
    ) -> "HeldOutErrors":
        """Compute the errors of the values of a fold from a fit to all values: `M^-1 r` with the covariance `M^-1`.

        If only these values determine an unknown, such as the position of a socket, M is singular. This unknown is
        treated as fitted to them, and the errors are scaled for the lost degrees of freedom (Cook and Weisberg 1982,
        section 2.2).

        Args:
            M: block of `I - X C X^T` for the held-out values, whitened.
            residual: residuals r of the held-out values, whitened.
            sensor: index of every value's sensor.
            sensor_counts: number of values of every sensor.
        """
        factor, failed = torch.linalg.cholesky_ex(M)
        if len(M) and (failed or float(factor.diagonal().min()) ** 2 < SINGULAR):
            values, vectors = torch.linalg.eigh(M)
            certain = values > SINGULAR
            inverse = (vectors * torch.where(certain, 1 / values, 0.0)) @ vectors.t()
            residual = residual * (len(M) / max(int(certain.sum()), 1)) ** 0.5
        else:
            inverse = torch.cholesky_inverse(factor)
        repetition = residual.new_tensor([one.repeat_variance_factor for one in sensor_counts])[sensor]
        spread = 1 + repetition * (inverse.diagonal() - 1).clamp(min=0)
        return HeldOutErrors((inverse @ residual) * repetition.sqrt(), spread.sqrt(), sensor)

    @staticmethod
    def concatenate(parts: "Sequence[HeldOutErrors]") -> "HeldOutErrors":
        """Concatenate the errors of several folds."""
        names = ("error", "predicted_sigma", "sensor")
        return HeldOutErrors(*(torch.cat([getattr(part, name) for part in parts]) for name in names))

    def rms(self, noise: Sequence[float], reference_sigmas: Sequence[float]) -> float:
        """Return the RMS error relative to given standard deviations, such as the noise of another model."""
        return float(self._squares(noise, reference_sigmas).mean().sqrt())

    def gain_in_standard_errors(
        self, noise: Sequence[float], before: "HeldOutErrors", noise_before: Sequence[float]
    ) -> float:
        """Return the decrease of the squared errors relative to another fit, in standard errors."""
        return sum_in_standard_errors(
            before._squares(noise_before, noise_before) - self._squares(noise, noise_before)
        )

    def _squares(self, noise: Sequence[float], unit: Sequence[float]) -> Float64[Tensor, " values"]:
        scale = self.error.new_tensor(noise) / self.error.new_tensor(unit)
        return (self.error * scale[self.sensor]).square()


def sum_in_standard_errors(values: Float64[Tensor, " values"]) -> float:
    """Return the sum of independent values divided by its standard error; 0 if all are equal."""
    scatter = (values.square().sum() - values.sum().square() / max(len(values), 1)).clamp(min=0).sqrt()
    return float(values.sum() / scatter) if float(scatter) > 0 else 0.0


def held_out_covariance_factor(errors: HeldOutErrors) -> float:
    """Return the factor >= 1 on the covariance of the unknowns for which held-out errors are as large as predicted.

    With errors e and predicted standard deviations s in units of the noise, it solves
    `mean(e² / (1 + f (s² - 1))) = 1`. Effects that the model cannot express make the factor larger than 1.
    """
    square, extra = errors.error.square(), errors.predicted_sigma.square() - 1
    low, high = 0.0, math.log(MAX_SCALE)
    if float((square / (1 + extra)).mean()) <= 1:
        return 1.0
    for _ in range(60):  # bisection in the logarithm
        middle = (low + high) / 2
        if float((square / (1 + math.exp(middle) * extra)).mean()) > 1:
            low = middle
        else:
            high = middle
    return math.exp(high)


_LEVEL = 1e-3
"""Probability, over all rows of a data set, of calling a row wrong although none is wrong."""


@dataclass(frozen=True)
class RowTest:
    """The row with the least probable error under the fit to all other rows.

    Attributes:
        row: index of the row.
        p_value: probability that the error of any row is at least this improbable if none is wrong (Bonferroni).
    """

    row: int
    p_value: float

    @property
    def is_wrong(self) -> bool:
        """Whether the other rows contradict the row."""
        return self.p_value < _LEVEL


def most_deviating_row(
    X: Float64[Tensor, "values unknowns"],
    y: Float64[Tensor, " values"],
    row: Int64[Tensor, " values"],
    has_exact_noise: Bool[Tensor, " values"],
) -> RowTest | None:
    """Find the row whose values the fit to all other rows predicts worst.

    With `M = I - X (X^T X)^-1 X^T` and its block M_k of the m values of a row, leaving out the row lowers the sum of
    squared residuals S by `T = r_k^T M_k^-1 r_k`. Without wrong rows, `(T / m) / ((S - T) / (f - m))`, with f degrees
    of freedom, has the distribution F(m, f - m), regardless of the noise (Cook and Weisberg 1982, Residuals and
    Influence in Regression, sections 2.2 and 5.1, for several values).

    Args:
        X: derivatives, in units of the noise.
        y: residuals of the fit, in units of the noise.
        row: index of every value's row.
        has_exact_noise: values that are not measured, such as priors; rows are tested without these values.

    Returns:
        The row; None if no row leaves degrees of freedom for the test.
    """
    from scipy.stats import f as f_distribution  # imported here, because importing scipy takes half a second

    U = orthonormal_columns(X)
    total, freedom = float(y.square().sum()), len(y) - U.shape[1]
    worst: RowTest | None = None
    numbers = torch.unique(row[~has_exact_noise]).tolist()
    for number in numbers:
        chosen = (row == number) & ~has_exact_noise
        block = torch.eye(int(chosen.sum()), dtype=y.dtype) - U[chosen] @ U[chosen].t()
        values, vectors = torch.linalg.eigh(block)
        certain = values > SINGULAR
        count = int(certain.sum())
        if count == 0 or freedom <= count:
            continue
        gain = float(((vectors.t() @ y[chosen])[certain].square() / values[certain]).sum())
        ratio = (gain / count) / max((total - gain) / (freedom - count), 1e-300)
        probability = min(1.0, len(numbers) * float(f_distribution.sf(ratio, count, freedom - count)))
        if worst is None or probability < worst.p_value:
            worst = RowTest(int(number), probability)
    return worst
