"""Rank tests of dependence and of differences, which assume no distribution of the errors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

SIGNIFICANT = 1e-3
"""p-value below which a dependence is called significant."""


def rank_correlation(
    x: Float64[np.ndarray, " values"], y: Float64[np.ndarray, " values"]
) -> tuple[float, float]:
    """Compute Spearman's rank correlation and its two-sided p-value.

    Returns:
        Correlation and p-value; 0 and 1 if either variable is constant or there are fewer than three values.
    """
    from scipy.stats import spearmanr

    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0, 1.0
    result = spearmanr(x, y)
    return float(result.statistic), float(result.pvalue)


def kruskal_wallis(
    group: Int64[np.ndarray, " values"], values: Float64[np.ndarray, " values"]
) -> tuple[float, float]:
    """Test whether groups have values of different size (Kruskal and Wallis 1952).

    Args:
        group: index of every value's group; indices without a value are ignored.
        values: the values.

    Returns:
        The statistic H and its p-value; 0 and 1 unless there are two groups and different values.
    """
    from scipy.stats import kruskal

    indices = np.unique(group)
    if len(indices) < 2 or len(values) < 3 or np.ptp(values) == 0:
        return 0.0, 1.0
    result = kruskal(*(values[group == index] for index in indices))
    return float(result.statistic), float(result.pvalue)


@dataclass(frozen=True)
class SignedRank:
    """Result of Wilcoxon's signed-rank test.

    Attributes:
        statistic: the smaller of the rank sums of positive and of negative differences.
        z: standardised statistic, at most 0; 0 if there is no difference.
        p: two-sided p-value for a symmetric distribution about 0.
        pairs: number of nonzero differences; the others are left out.
    """

    statistic: float
    z: float
    p: float
    pairs: int


def signed_rank(differences: Float64[np.ndarray, " pairs"]) -> SignedRank:
    """Test whether paired differences are symmetric about 0 (Wilcoxon 1945), by the normal approximation with ties."""
    from scipy.stats import wilcoxon

    pairs = int(np.count_nonzero(differences))
    if pairs == 0:
        return SignedRank(0.0, 0.0, 1.0, 0)
    result = wilcoxon(differences, zero_method="wilcox", correction=False, method="asymptotic")
    return SignedRank(float(result.statistic), -abs(float(result.zstatistic)), float(result.pvalue), pairs)
