"""Parameters of two models that differ significantly, given the uncertainties of both."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.lifetime.comparison.model_pair import ModelPair, nominal_robot
from pisigma.lifetime.comparison.parameter_effects import Difference, ParameterEffects
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit
from pisigma.model.accuracy import parameter_posterior
from pisigma.model.calibrated_model import CalibratedModel

_LEVEL = 0.01
"""Family-wise significance level: probability of calling any parameter different if two models differ only by
chance."""
_FACTORS = dict(SHOWN_UNITS.values())
"""Factors from SI by the shown unit, such as "mm" or "deg"."""


@dataclass(frozen=True)
class ParameterDifference:
    """One parameter of the arm in two models.

    Attributes:
        name: name such as "theta_3", a DH parameter.
        unit: "mm", "deg", "px" or "1", of all figures.
        first: value in the first model.
        second: value in the second model.
        sigmas: posterior standard deviations; None if a model stores no posterior.
        shift: estimated difference given the significant differences, with base and tool free if these are fitted; None
            without posteriors, or if the parameter moves the tool in the same way as those parameters.
        sigma: standard deviation of the shift.
        p_value: probability of a shift at least this large by chance, times the number of tested parameters
            (Bonferroni).
        equivalent_parameters: names of parameters with the same effect on the tool.
    """

    name: str
    unit: ShownUnit
    first: float
    second: float
    sigmas: tuple[float | None, float | None]
    shift: float | None = None
    sigma: float | None = None
    p_value: float | None = None
    equivalent_parameters: tuple[str, ...] = ()

    @property
    def difference(self) -> float:
        """Second value minus the first; angles wrapped to ±180 deg."""
        by = self.second - self.first
        return (by + 180.0) % 360.0 - 180.0 if self.unit == "deg" else by


@dataclass(frozen=True)
class Remainder:
    """Test of the displacement that base, tool and the significant parameters do not explain.

    Attributes:
        p_value: probability of a displacement at least this large by chance.
        significant: whether p is below the significance level.
    """

    p_value: float
    significant: bool


@dataclass(frozen=True)
class ParameterDifferences:
    """Parameters of two models side by side, and the significant differences.

    Attributes:
        parameters: all DH parameters of the arm.
        significant_differences: significant differences, estimated together; a joint zero counts in the direction of
            the joint.
        frame_movements: distances and angles by which base and tool of the second model differ, for fitted frames only.
        remainder: test of the remaining displacement; None without posteriors.
        significance_level: family-wise significance level.
    """

    parameters: tuple[ParameterDifference, ...]
    significant_differences: tuple[Difference, ...]
    frame_movements: tuple[Movement, ...]
    remainder: Remainder | None
    significance_level: float


def parameter_differences(pair: ModelPair, significance_level: float = _LEVEL) -> ParameterDifferences:
    """Test which parameters of two models differ.

    Differences e of the parameters displace the tool by `d = J e`. Under posteriors with covariances `C1` and `C2`, d
    is normal with the covariance `X1 C1 X1^T + X2 C2 X2^T`, where X are derivatives with respect to all unknowns,
    including the weights of a joint correction. The corrections may therefore be of different kinds, and unobservable
    differences are ignored. Base and tool are free if frames are fitted. The parameter whose shift alone explains most
    of d is tested, at the level over the number of parameters (Bonferroni); further parameters are then added one by
    one until no other parameter is significant.

    Args:
        pair: the models.
        significance_level: family-wise significance level.
    """
    parameters = _side_by_side(pair)
    if any(model.uncertainty is None and not _is_nominal(model) for model in (pair.first, pair.second)):
        return ParameterDifferences(parameters, (), (), None, significance_level)
    effects = ParameterEffects(pair)
    threshold = NormalDist().inv_cdf(1 - significance_level / (2 * max(len(effects.tested), 1)))
    chosen: list[int] = []
    while float((scores := effects.standard_scores(chosen)).abs().amax()) > threshold:
        chosen.append(int(scores.abs().argmax()))
    p = effects.remainder_p_value(chosen)
    tested = (_tested(effects, number, one, chosen, parameters) for number, one in enumerate(parameters))
    return ParameterDifferences(
        tuple(tested),
        *effects.estimate_shifts(chosen),
        remainder=Remainder(p, p < significance_level),
        significance_level=significance_level,
    )


def _tested(
    effects: ParameterEffects,
    number: int,
    parameter: ParameterDifference,
    chosen: Sequence[int],
    parameters: Sequence[ParameterDifference],
) -> ParameterDifference:
    """Test a parameter given the significant parameters, except itself and parameters with the same effect."""
    alike = effects.parameters_with_same_effect(number)
    estimate = effects.shift(number, [one for one in chosen if one not in (number, *alike)])
    if estimate is None:
        return parameter
    shift, deviation = estimate
    chance = math.erfc(abs(shift) / deviation / math.sqrt(2)) * len(effects.tested)
    factor = _FACTORS[parameter.unit]
    return replace(
        parameter,
        shift=shift * factor,
        sigma=deviation * factor,
        p_value=min(chance, 1.0),
        equivalent_parameters=tuple(parameters[one].name for one in alike if one < len(parameters)),
    )


def _side_by_side(pair: ModelPair) -> tuple[ParameterDifference, ...]:
    """Return the values and their standard deviations, without tests."""
    space = ParameterSpace(nominal_robot(pair.first))
    models = pair.first, pair.second
    values = [model.identified.dh.ravel() for model in models]
    known = [_deviations(model, space.arm_parameter_count) for model in models]
    parameters = []
    for number, parameter in enumerate(space.parameters[: space.arm_parameter_count]):
        unit, factor = SHOWN_UNITS[parameter.unit]
        first, second = (float(those[number]) * factor for those in values)
        own, other = (None if those is None else float(those[number]) * factor for those in known)
        parameters.append(ParameterDifference(parameter.name, unit, first, second, (own, other)))
    return tuple(parameters)


def _deviations(model: CalibratedModel, count: int) -> Tensor | None:
    """Return the standard deviations of the arm's parameters; 0 for a nominal robot."""
    posterior = parameter_posterior(model)
    if posterior is not None:
        return posterior.standard_errors[:count]
    return torch.zeros(count, dtype=torch.float64) if _is_nominal(model) else None


def _is_nominal(model: CalibratedModel) -> bool:
    """Return whether a model is the nominal robot, which has no uncertainty."""
    if model.network is not None or model.hybrid is not None:
        return False
    return bool(np.array_equal(model.identified.dh, nominal_robot(model).dh))
