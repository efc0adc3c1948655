"""Settings of a measuring session: when it stops, and how often it replans."""

import math
from dataclasses import dataclass
from typing import Annotated

from pisigma.files.errors import PlanningError
from pisigma.files.setting import KEY


@dataclass(frozen=True)
class MeasureSettings:
    """Settings of a measuring session: when it stops, and how often it replans.

    Attributes:
        limit_mm: stop when the expected 95 % quantile of the tool's position errors is below this [mm].
        least_gain_mm: stop when 10 more poses would lower the expected 95 % quantile of the errors by less than
            this [mm].
        every: number of rows between updates of the accuracy and of the plan.
        replan: replan the remaining poses.

    Raises:
        PlanningError: a number is out of range.
    """

    limit_mm: float | None = None
    least_gain_mm: Annotated[float, KEY] = 0.005
    every: Annotated[int, KEY] = 3
    replan: Annotated[bool, KEY] = True

    def __post_init__(self) -> None:
        """Check ranges."""
        if self.limit_mm is not None and not 0 < self.limit_mm < math.inf:
            raise PlanningError(expected="a finite length > 0 mm", value=self.limit_mm, option="limit_mm")
        if not 0 <= self.least_gain_mm < math.inf:
            raise PlanningError(
                expected="a finite length >= 0 mm", value=self.least_gain_mm, option="least_gain_mm"
            )
        if self.every < 1:
            raise PlanningError(expected="1 row or more", value=self.every, option="every")
