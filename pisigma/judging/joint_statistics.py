"""Joint errors in the papers' form: average, deviation and maximum of the absolute error."""

from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float64
from torch import Tensor


@dataclass(frozen=True)
class JointStatistics:
    """Of the absolute error of one joint (Jeong et al. 1998, Tables 1 and 2) [rad or m].

    Attributes:
        average: mean of the absolute error.
        deviation: standard deviation of the absolute error, over all rows (divided by n, as the paper's
            figures are).
        maximum: largest absolute error.
    """

    average: float
    deviation: float
    maximum: float

    @staticmethod
    def of(errors: Float64[Tensor, " rows"]) -> "JointStatistics":
        """Statistics of the errors of one joint."""
        absolute = errors.abs()
        return JointStatistics(
            float(absolute.mean()), float(absolute.std(correction=0)), float(absolute.max())
        )

    def in_file_units(self, revolute: bool) -> dict[str, float]:
        """The figures in degrees or millimetres, with the unit in the names."""
        unit, factor = ("deg", float(np.rad2deg(1.0))) if revolute else ("mm", 1e3)
        return {f"{name}_{unit}": value * factor for name, value in asdict(self).items()}
