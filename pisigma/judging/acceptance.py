"""Limits that a model has to meet to be accepted."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from pisigma.errors import MeasurementError
from pisigma.reporting.tables import figure_text

_NAMES = {
    "mean_mm": ("max-mean-mm", "mean position error"),
    "p95_mm": ("max-p95-mm", "95 % quantile of the position error"),
    "max_mm": ("max-mm", "largest position error"),
    "mean_deg": ("max-mean-deg", "mean orientation error"),
}


@dataclass(frozen=True)
class Limits:
    """Largest errors that are accepted; None where there is no limit.

    Attributes:
        mean_mm: of the mean position error.
        p95_mm: of the position error that 95 % of the rows stay below.
        max_mm: of the largest position error.
        mean_deg: of the mean orientation error.
    """

    mean_mm: float | None = None
    p95_mm: float | None = None
    max_mm: float | None = None
    mean_deg: float | None = None

    def __post_init__(self) -> None:
        """Refuse limits that no figure could be held against."""
        for name, limit in self.given.items():
            if not (limit > 0 and math.isfinite(limit)):
                raise MeasurementError(f"--{_NAMES[name][0]} {limit:g}: a limit above 0 was wanted.")

    @property
    def given(self) -> dict[str, float]:
        """The limits that there are."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def missed(self, model: Mapping[str, Any]) -> list[str]:
        """What a model does not meet, in sentences without their ends; empty where it meets all.

        A model that predicts nothing for a row does not meet any limit there is.

        Args:
            model: one of "models" in what `pisigma.reporting.comparison_report.report_comparison` gives.

        Raises:
            MeasurementError: there is a limit on the orientation, but none was measured.
        """
        name, found = model["name"], []
        for key, limit in self.given.items():
            option, what = _NAMES[key]
            if key not in model:
                raise MeasurementError(
                    f"--{option} {limit:g}: no orientations were measured; leave the limit out or give poses."
                )
            if not model[key] <= limit:
                unit = key.rsplit("_", 1)[1]
                value = (
                    figure_text(model[key]) if figure_text(model[key]) != figure_text(limit) else model[key]
                )
                found.append(f"the {what} of {name} is {value} {unit}, --{option} allows {limit:g} {unit}")
        if self.given and model["rows_not_predicted"]:
            found.append(f"{name} predicts nothing for {model['rows_not_predicted']} of the rows")
        return found
