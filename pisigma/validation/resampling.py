"""How often what was measured is drawn again, for confidence intervals."""

from dataclasses import dataclass
from typing import Annotated

from pisigma.files.errors import MeasurementError
from pisigma.files.setting import HIDDEN, Option

MOST_RESAMPLES = 1_000_000


@dataclass(frozen=True)
class Bootstrap:
    """Percentile bootstrap (Efron and Tibshirani 1993, chapter 13) over groups of rows that belong together.

    Rows of one configuration share most of their error, so groups and not rows are drawn, as many as there are, with
    replacement.

    Attributes:
        resamples: number of bootstrap resamples for confidence intervals.
        seed: random seed of the resamples. Equal seeds draw equal groups, so that models are compared on the same ones.
        confidence: confidence level of an interval.
    """

    resamples: Annotated[int, Option(min=2)] = 2000
    seed: int = 0
    confidence: Annotated[float, HIDDEN] = 0.95

    def __post_init__(self) -> None:
        """Refuse settings that give no interval."""
        if not 2 <= self.resamples <= MOST_RESAMPLES or not 0 < self.confidence < 1 or self.seed < 0:
            raise MeasurementError(
                f"bootstrap: 2 resamples or more and a confidence between 0 and 1 were wanted, a seed from 0 and up to "
                f"{MOST_RESAMPLES:,} resamples, got {self.resamples}, {self.confidence:g} and seed {self.seed}."
            )
