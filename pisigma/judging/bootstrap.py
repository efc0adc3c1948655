"""Confidence intervals of error statistics by drawing whole configurations again and again."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.errors import MeasurementError

QUANTILE = 0.95
"""Of the statistic "p95"."""

_DRAWN = 2**22
"""Numbers that are drawn and summed at a time."""

Statistics = dict[str, Float64[Tensor, "resamples models"]]
"""By name of the statistic ("mean", "rms", "p95") its value in every resample and under every model."""


@dataclass(frozen=True)
class Bootstrap:
    """Percentile bootstrap (Efron & Tibshirani 1993, chapter 13) over groups of rows that belong together.

    Rows of one configuration share most of their error, so that groups and not rows are drawn, as many as there are,
    with replacement. The maximum has no interval: no resample exceeds what was measured.

    Attributes:
        resamples: how often groups are drawn.
        seed: of the drawing; equal seeds draw equal groups, so that models are compared on the same resamples.
        confidence: share of the resamples within an interval.
    """

    resamples: int = 2000
    seed: int = 0
    confidence: float = 0.95

    def __post_init__(self) -> None:
        """Refuse what gives no interval."""
        if self.resamples < 2 or not 0 < self.confidence < 1:
            raise MeasurementError(
                f"bootstrap: 2 resamples or more and a confidence between 0 and 1 were wanted, got {self.resamples} "
                f"and {self.confidence:g}."
            )

    def statistics(self, errors: Float64[Tensor, "models rows"], group: Int64[Tensor, " rows"]) -> Statistics:
        """Statistics of every resample.

        Args:
            errors: of the same rows under every model, lengths or angles [m or rad]; none is NaN.
            group: number of every row's group, from 0; every number occurs.
        """
        sizes = torch.bincount(group).double()
        sums = errors.new_zeros(len(sizes), 2 * len(errors))
        sums.index_add_(0, group, torch.cat([errors, errors.square()]).t())
        found = []
        for counts in self._draws(len(sizes), errors.shape[1]):
            rows = (counts @ sizes)[:, None]
            mean, square = ((counts @ sums) / rows).chunk(2, 1)
            quantile = torch.stack([_quantile(values, counts[:, group]) for values in errors], 1)
            found.append((mean, square.sqrt(), quantile))
        return dict(
            zip(("mean", "rms", "p95"), (torch.cat(parts) for parts in zip(*found, strict=True)), strict=True)
        )

    def intervals(
        self, values: Float64[Tensor, "resamples models"], groups: int
    ) -> Float64[Tensor, "models 2"]:
        """Lower and upper end of the interval of every model; NaN where there is a single group.

        Args:
            values: a statistic of every resample, or the difference of two.
            groups: how many were drawn from.
        """
        if groups < 2:
            return values.new_full((values.shape[1], 2), torch.nan)
        tail = (1 - self.confidence) / 2
        return torch.quantile(values, values.new_tensor([tail, 1 - tail]), dim=0).t()

    def _draws(self, groups: int, rows: int) -> Iterator[Float64[Tensor, "some groups"]]:
        """How often every group was drawn, some resamples at a time."""
        generator = torch.Generator().manual_seed(self.seed)
        step = max(1, _DRAWN // max(groups, rows))
        for first in range(0, self.resamples, step):
            count = min(step, self.resamples - first)
            drawn = torch.randint(groups, (count, groups), generator=generator)
            counts = torch.zeros(count, groups, dtype=torch.float64)
            yield counts.scatter_add_(1, drawn, torch.ones_like(counts))


def _quantile(
    values: Float64[Tensor, " rows"], counts: Float64[Tensor, "some rows"]
) -> Float64[Tensor, " some"]:
    """The quantile `QUANTILE` of values of which each counts so often, linear between neighbours as numpy's."""
    values, order = values.sort()
    up_to = counts[:, order].cumsum(1)
    total = up_to[:, -1:]
    place = QUANTILE * (total - 1)
    below = place.floor()
    ends = torch.cat([below, torch.minimum(below + 1, total - 1)], 1)
    low, high = values[torch.searchsorted(up_to, ends, right=True)].unbind(1)
    return low + (place - below)[:, 0] * (high - low)
