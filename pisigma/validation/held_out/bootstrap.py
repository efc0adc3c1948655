"""Confidence intervals of error statistics, by resampling whole configurations."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.validation.resampling import Bootstrap

STATISTICS = ("mean", "rms", "p95")
"""Statistics that have an interval; the maximum has none, as no resample exceeds what was measured."""
QUANTILE = 0.95
"""Of the statistic "p95"."""

_BATCH = 2**22
"""Indices that are drawn at a time, at most."""


@dataclass(frozen=True)
class Intervals:
    """Confidence intervals of the statistics in `STATISTICS`, of several models [m or rad].

    Attributes:
        value: lower and upper end of each statistic of each model; NaN where there is one configuration only.
        difference: the same of its difference to the first model's.
    """

    value: Float64[np.ndarray, "statistics models 2"]
    difference: Float64[np.ndarray, "statistics models 2"]


def confidence_intervals(
    bootstrap: Bootstrap, errors: Float64[np.ndarray, "models rows"], group: Int64[np.ndarray, " rows"]
) -> Intervals:
    """Compute the intervals of all models on the same resamples.

    Args:
        bootstrap: how they are computed.
        errors: of the same rows under every model, lengths or angles [m or rad]; none is NaN.
        group: index of every row's group, from 0; every index occurs.
    """
    from scipy import stats

    groups = int(group.max()) + 1
    if groups < 2:
        unknown = np.full((len(STATISTICS), len(errors), 2), np.nan)
        return Intervals(unknown, unknown)
    order = np.argsort(group, kind="stable")
    sizes, errors = np.bincount(group), errors[:, order]

    def of_resample(drawn: Int64[np.ndarray, " groups"]) -> np.ndarray:
        times = np.bincount(drawn.astype(np.int64), minlength=groups)
        values = statistics(np.repeat(errors, np.repeat(times, sizes), axis=1))
        return np.stack([values, values - values[:, :1]])

    result = stats.bootstrap(
        (np.arange(groups),),
        of_resample,
        vectorized=False,
        method="percentile",
        n_resamples=bootstrap.resamples,
        confidence_level=bootstrap.confidence,
        batch=max(1, _BATCH // groups),
        rng=np.random.default_rng(bootstrap.seed),
    )
    return Intervals(*np.stack([result.confidence_interval.low, result.confidence_interval.high], -1))


def statistics(errors: Float64[np.ndarray, "models rows"]) -> Float64[np.ndarray, "statistics models"]:
    """Compute mean, root mean square and 95 % quantile of every model's errors, as `STATISTICS` names them."""
    quantile = np.quantile(errors, QUANTILE, axis=1)
    return np.stack([errors.mean(1), np.sqrt((errors**2).mean(1)), quantile])
