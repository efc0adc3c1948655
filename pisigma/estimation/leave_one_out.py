"""Test whether one row contradicts all others in a linear least-squares fit."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from pisigma.estimation.held_out import SINGULAR
from pisigma.estimation.orthonormal_columns import orthonormal_columns

_LEVEL = 1e-3
"""Probability, over all rows of a data set, of calling a row wrong although none is wrong."""


@dataclass(frozen=True)
class RowTest:
    """The row with the least probable error under the fit to all other rows.

    Attributes:
        row: index of the row.
        probability: probability that the error of any row is at least this improbable if none is wrong (Bonferroni).
    """

    row: int
    probability: float

    @property
    def is_wrong(self) -> bool:
        """Whether the other rows contradict the row."""
        return self.probability < _LEVEL


def most_deviating_row(
    X: Float64[Tensor, "values unknowns"],
    y: Float64[Tensor, " values"],
    row: Int64[Tensor, " values"],
    exact: Bool[Tensor, " values"],
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
        exact: values that are not measured, such as priors; rows are tested without these values.

    Returns:
        The row; None if no row leaves degrees of freedom for the test.
    """
    from scipy.stats import f as f_distribution  # imported here, because importing scipy takes half a second

    U = orthonormal_columns(X)
    total, freedom = float(y.square().sum()), len(y) - U.shape[1]
    worst: RowTest | None = None
    numbers = torch.unique(row[~exact]).tolist()
    for number in numbers:
        chosen = (row == number) & ~exact
        block = torch.eye(int(chosen.sum()), dtype=y.dtype) - U[chosen] @ U[chosen].t()
        values, vectors = torch.linalg.eigh(block)
        certain = values > SINGULAR
        count = int(certain.sum())
        if count == 0 or freedom <= count:
            continue
        gain = float(((vectors.t() @ y[chosen])[certain].square() / values[certain]).sum())
        ratio = (gain / count) / max((total - gain) / (freedom - count), 1e-300)
        probability = min(1.0, len(numbers) * float(f_distribution.sf(ratio, count, freedom - count)))
        if worst is None or probability < worst.probability:
            worst = RowTest(int(number), probability)
    return worst
