"""Settings of the bootstrap for confidence intervals."""

from dataclasses import dataclass
from typing import Annotated

from pisigma.files.errors import MeasurementError
from pisigma.files.setting import HIDDEN, KEY, Option

_MAX_RESAMPLES = 1_000_000


@dataclass(frozen=True)
class Bootstrap:
    """Percentile bootstrap (Efron and Tibshirani 1993, chapter 13) over groups of rows with equal joint values.

    Rows of one configuration share most of their error. Therefore groups, not rows, are drawn with replacement.

    Attributes:
        resamples: number of bootstrap resamples for confidence intervals.
        seed: random seed of the resamples. Equal seeds draw equal groups, so that models are compared on the same
            groups.
        confidence: confidence level of an interval.
    """

    resamples: Annotated[int, Option(min=2, is_key_only=True)] = 2000
    seed: Annotated[int, KEY] = 0
    confidence: Annotated[float, HIDDEN] = 0.95

    def __post_init__(self) -> None:
        """Refuse settings that do not define an interval."""
        for name, valid, expected in (
            ("resamples", 2 <= self.resamples <= _MAX_RESAMPLES, f"2 to {_MAX_RESAMPLES:,} resamples"),
            ("confidence", 0 < self.confidence < 1, "a confidence level between 0 and 1"),
            ("seed", self.seed >= 0, "a seed of at least 0"),
        ):
            if not valid:
                raise MeasurementError(option=name, expected=expected, value=getattr(self, name))
