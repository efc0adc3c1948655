"""Estimated sizes of the errors of parameters, compared with their prior standard deviations."""

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation, covariance_of
from pisigma.calibration.geometric.problem.noise import sensor_view_of
from pisigma.calibration.geometric.problem.prior_scales import LENGTH_GROUPS, PriorGroup, effective_parameters
from pisigma.calibration.geometric.problem.problem import CalibrationProblem


@dataclass(frozen=True)
class PriorRatio:
    """Ratio of the estimated size of the errors of a group of parameters to their prior standard deviation.

    Attributes:
        kind: "length" or "angle".
        group: the group of parameters.
        prior: smallest prior standard deviation of a parameter of the group [m or rad].
        value: the estimated ratio [1].
        lower_bound: the ratio minus two standard deviations. An estimate from n effective parameters has a relative
            standard deviation of about `1 / sqrt(2 n)`, so this is `exp(-sqrt(2 / n))` times the estimate.
    """

    kind: Literal["length", "angle"]
    group: PriorGroup
    prior: float
    value: float
    lower_bound: float

    @property
    def size(self) -> float:
        """Estimated standard deviation of the errors [m or rad]."""
        return self.value * self.prior

    @property
    def size_at_least(self) -> float:
        """The estimated standard deviation of the errors minus two of its own standard deviations [m or rad]."""
        return self.lower_bound * self.prior


def prior_ratios_of(
    problem: CalibrationProblem, linearisation: Linearisation[Tensor]
) -> tuple[PriorRatio, ...]:
    """Return the ratios of all groups of parameters with a prior.

    Args:
        problem: the problem with its free parameters.
        linearisation: the problem linearised at its solution.
    """
    view = sensor_view_of(linearisation)
    precision, group = problem.precision[problem.active], problem.prior_group
    effective = effective_parameters(
        precision, group, view.prior_scale, covariance_of(linearisation.normal)
    ).tolist()
    ratios = []
    for number in sorted(set(group[precision > 0].tolist())):
        if effective[number] > 0:
            scale = float(view.prior_scale[number])
            prior = float(precision[(group == number) & (precision > 0)].max()) ** -0.5
            at_least = scale * math.exp(-((2 / effective[number]) ** 0.5))
            kind: Literal["length", "angle"] = "length" if number in LENGTH_GROUPS else "angle"
            ratios.append(PriorRatio(kind, PriorGroup(number), prior, scale, at_least))
    return tuple(ratios)
