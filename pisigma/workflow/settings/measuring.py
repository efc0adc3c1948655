"""When a session of measuring stops, and how often it is judged."""

import math
from dataclasses import dataclass

from pisigma.files.errors import PlanningError


@dataclass(frozen=True)
class MeasureSettings:
    """When a session stops, and how often it is judged.

    Attributes:
        limit_mm: stop where 95 % of the errors are expected below this [mm].
        least_gain_mm: stop where the next 10 poses would lower these 95 % by less than this [mm].
        every: rows after which the accuracy is worked out and the rest planned again.
        replan: plan what is left again.

    Raises:
        PlanningError: a setting is no number that it can be.
    """

    limit_mm: float | None = None
    least_gain_mm: float = 0.005
    every: int = 3
    replan: bool = True

    def __post_init__(self) -> None:
        """Refuse settings that are none."""
        if self.limit_mm is not None and not 0 < self.limit_mm < math.inf:
            raise PlanningError(f"limit: a length above 0 was wanted, got {self.limit_mm:g} mm.")
        if not 0 <= self.least_gain_mm < math.inf:
            raise PlanningError(
                f"least gain: a length of 0 or more was wanted, got {self.least_gain_mm:g} mm."
            )
        if self.every < 1:
            raise PlanningError(f"every: 1 row or more was wanted, got {self.every}.")
