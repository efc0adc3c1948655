"""Errors of one model against those of another on the same rows."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.judging.bootstrap import Bootstrap, Statistics
from pisigma.judging.signed_rank import SignedRank, signed_rank

COMPARED = ("mean", "rms", "p95")
"""Statistics whose differences are looked at."""


@dataclass(frozen=True, eq=False)
class PairedComparison:
    """Errors of a model minus those of a reference, below 0 where the model is better [m or rad].

    Attributes:
        difference: by statistic ("mean", "rms", "p95").
        interval: by statistic, lower and upper end of the confidence interval; NaN where there is one configuration.
        test: Wilcoxon's test of the configurations' mean differences.
        better: share of the configurations in which the model's mean error is smaller.
        configurations: how many there are.
    """

    difference: dict[str, float]
    interval: dict[str, tuple[float, float]]
    test: SignedRank
    better: float
    configurations: int

    @staticmethod
    def of(
        errors: Float64[Tensor, " rows"],
        reference: Float64[Tensor, " rows"],
        group: Int64[Tensor, " rows"],
        bootstrap: Bootstrap,
    ) -> "PairedComparison":
        """Compare on rows that both have.

        Args:
            errors: of the model [m or rad].
            reference: of the other, of the same rows.
            group: number of every row's configuration, from 0; every number occurs.
            bootstrap: draws the configurations.
        """
        both = torch.stack([reference, errors])
        return paired_comparisons(both, group, bootstrap, bootstrap.statistics(both, group))[1]

    def in_file_units(self, unit: str) -> dict[str, object]:
        """The figures in "mm" or "deg"; None where there is no interval."""
        factor = 1e3 if unit == "mm" else float(np.rad2deg(1.0))
        found: dict[str, object] = {}
        for name, value in self.difference.items():
            ends = [end * factor for end in self.interval[name]]
            found[f"{name}_{unit}"] = value * factor
            found[f"{name}_{unit}_interval"] = None if np.isnan(ends).any() else ends
        test = {
            "statistic": self.test.statistic,
            "z": self.test.z,
            "p": self.test.p,
            "pairs": self.test.pairs,
        }
        return {**found, "better_share": self.better, "wilcoxon": test}


def paired_comparisons(
    errors: Float64[Tensor, "models rows"],
    group: Int64[Tensor, " rows"],
    bootstrap: Bootstrap,
    resampled: Statistics,
) -> tuple[PairedComparison, ...]:
    """Every model against the first, the first against itself too.

    Args:
        errors: of the same rows under every model [m or rad].
        group: number of every row's configuration, from 0; every number occurs.
        bootstrap: what drew the configurations.
        resampled: its statistics of these errors.
    """
    sizes = torch.bincount(group).double()
    own = {"mean": errors.mean(1), "rms": errors.square().mean(1).sqrt(), "p95": errors.quantile(0.95, dim=1)}
    intervals = {
        name: bootstrap.intervals(resampled[name] - resampled[name][:, :1], len(sizes)) for name in COMPARED
    }
    mean = errors.new_zeros(len(sizes), len(errors)).index_add_(0, group, errors.t()) / sizes[:, None]
    found = []
    for model in range(len(errors)):
        off = mean[:, model] - mean[:, 0]
        found.append(
            PairedComparison(
                difference={name: float(own[name][model] - own[name][0]) for name in COMPARED},
                interval={name: tuple(intervals[name][model].tolist()) for name in COMPARED},
                test=signed_rank(off),
                better=float((off < 0).double().mean()),
                configurations=len(sizes),
            )
        )
    return tuple(found)
