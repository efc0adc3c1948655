"""Whether errors depend on something more than by chance, from ranks alone: no assumption of how they are spread."""

import math

import numpy as np
import torch
from jaxtyping import Float64, Int64

SIGNIFICANT = 1e-3
"""Dependencies less likely by chance than this are called significant."""


def ranks(values: Float64[np.ndarray, " values"]) -> Float64[np.ndarray, " values"]:
    """Ranks from 1; equal values share the mean of theirs."""
    _, number, counts = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    shared: Float64[np.ndarray, " values"] = (last - (counts - 1) / 2)[number]
    return shared


def rank_correlation(
    x: Float64[np.ndarray, " values"], y: Float64[np.ndarray, " values"]
) -> tuple[float, float]:
    """Spearman's rank correlation, and how likely one as large is by chance.

    The probability is that of the normal approximation `r sqrt(n - 1)` (Kendall and Gibbons 1990, Rank Correlation
    Methods, section 4.13).

    Returns:
        Correlation and probability; 0 and 1 where either is constant or there are fewer than three values.
    """
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return 0.0, 1.0
    r = float(np.corrcoef(ranks(x), ranks(y))[0, 1])
    return r, math.erfc(abs(r) * math.sqrt(len(x) - 1) / math.sqrt(2))


def groups_differ(
    group: Int64[np.ndarray, " values"], values: Float64[np.ndarray, " values"]
) -> tuple[float, float]:
    """Kruskal and Wallis' test of whether groups have values of different size.

    `H = 12 / (n (n + 1)) Σ R_g^2 / n_g - 3 (n + 1)`, divided by `1 - Σ (t^3 - t) / (n^3 - n)` for ties, against
    chi-squared (Kruskal and Wallis 1952, J. Amer. Statist. Assoc. 47(260), 583-621).

    Args:
        group: number of every value's group, from 0; empty ones do not count.
        values: to compare.

    Returns:
        H and its probability by chance; 0 and 1 where there are not two groups of different values.
    """
    n, used = len(values), np.unique(group)
    if len(used) < 2 or n < 3 or np.ptp(values) == 0:
        return 0.0, 1.0
    rank = ranks(values)
    sums, counts = (np.bincount(group, weights=w)[used] for w in (rank, np.ones(n)))
    ties = np.unique(values, return_counts=True)[1].astype(float)
    H = 12 / (n * (n + 1)) * float((sums**2 / counts).sum()) - 3 * (n + 1)
    H /= 1 - float((ties**3 - ties).sum()) / (n**3 - n)
    degrees = torch.tensor([(len(used) - 1) / 2, H / 2], dtype=torch.float64).clamp(min=0)
    return H, float(torch.special.gammaincc(degrees[0], degrees[1]))


def chance_text(probability: float) -> str:
    """A probability in words, such as "p = 0.02"."""
    return "p < 1e-12" if probability < 1e-12 else f"p = {probability:.2g}"
