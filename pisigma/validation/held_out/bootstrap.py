"""Confidence intervals of error statistics, by resampling whole configurations."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from pisigma.files.errors import MeasurementError

STATISTICS = ("mean", "rms", "p95")
"""Statistics that have an interval; the maximum has none, as no resample exceeds what was measured."""
MOST_RESAMPLES = 1_000_000
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


@dataclass(frozen=True)
class Bootstrap:
    """Percentile bootstrap (Efron and Tibshirani 1993, chapter 13) over groups of rows that belong together.

    Rows of one configuration share most of their error, so groups and not rows are drawn, as many as there are, with
    replacement.

    Attributes:
        resamples: number of times that groups are drawn.
        seed: of the drawing; equal seeds draw equal groups, so that models are compared on the same resamples.
        confidence: share of the resamples within an interval.
    """

    resamples: int = 2000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        """Refuse settings that give no interval."""
        if not 2 <= self.resamples <= MOST_RESAMPLES or not 0 < self.confidence < 1 or self.seed < 0:
            raise MeasurementError(
                f"bootstrap: 2 resamples or more and a confidence between 0 and 1 were wanted, a seed from 0 and up to "
                f"{MOST_RESAMPLES:,} resamples, got {self.resamples}, {self.confidence:g} and seed {self.seed}."
            )

    def intervals(
        self, errors: Float64[np.ndarray, "models rows"], group: Int64[np.ndarray, " rows"]
    ) -> Intervals:
        """Compute the intervals of all models on the same resamples.

        Args:
            errors: of the same rows under every model, lengths or angles [m or rad]; none is NaN.
            group: index of every row's group, from 0; every index occurs.
        """
        from scipy.stats import bootstrap

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

        result = bootstrap(
            (np.arange(groups),),
            of_resample,
            vectorized=False,
            method="percentile",
            n_resamples=self.resamples,
            confidence_level=self.confidence,
            batch=max(1, _BATCH // groups),
            rng=np.random.default_rng(self.seed),
        )
        return Intervals(*np.stack([result.confidence_interval.low, result.confidence_interval.high], -1))


def statistics(errors: Float64[np.ndarray, "models rows"]) -> Float64[np.ndarray, "statistics models"]:
    """Compute mean, root mean square and 95 % quantile of every model's errors, as `STATISTICS` names them."""
    quantile = np.quantile(errors, QUANTILE, axis=1)
    return np.stack([errors.mean(1), np.sqrt((errors**2).mean(1)), quantile])
