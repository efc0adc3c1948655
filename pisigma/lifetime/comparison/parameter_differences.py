"""Which parameters of two models differ by more than both models' uncertainties allow."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.problem.parameters import ParameterSpace
from pisigma.lifetime.comparison.model_pair import ModelPair, as_drawn
from pisigma.lifetime.comparison.parameter_effects import Difference, ParameterEffects
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit
from pisigma.model.accuracy import parameter_posterior
from pisigma.model.calibrated_model import CalibratedModel

LEVEL = 0.01
"""Probability with which anything at all is called different where two models differ by chance alone."""
FACTORS = dict(SHOWN_UNITS.values())
"""By "mm" or "deg" what an SI value is multiplied by."""


@dataclass(frozen=True)
class ParameterDifference:
    """One parameter of the arm in two models.

    Attributes:
        name: such as "theta_3".
        unit: "mm", "deg", "px" or "1", of all figures.
        first: its value in the first model.
        second: its value in the second.
        deviations: standard deviation of each by the posteriors; None where the model holds none.
        shift: by how much it differs if nothing else does but the parameters that differ, and base and tool where these
            are fitted; None without posteriors, and where it moves the tool as those do.
        deviation: standard deviation of the shift.
        p: probability of such a shift or a larger one by chance, times the number of parameters that are tested.
        alike: the names of parameters that have the very same effect.
    """

    name: str
    unit: ShownUnit
    first: float
    second: float
    deviations: tuple[float | None, float | None]
    shift: float | None = None
    deviation: float | None = None
    p: float | None = None
    alike: tuple[str, ...] = ()

    @property
    def difference(self) -> float:
        """The second value less the first, of angles the short way round."""
        by = self.second - self.first
        return (by + 180.0) % 360.0 - 180.0 if self.unit == "deg" else by


@dataclass(frozen=True)
class Remainder:
    """What is left of the differences beside base, tool and the parameters that differ.

    Attributes:
        p: probability of that much or more by chance.
        significant: whether that is below the level.
    """

    p: float
    significant: bool


@dataclass(frozen=True)
class ParameterDifferences:
    """The parameters of two models side by side, and which of them differ.

    Attributes:
        parameters: all of the arm.
        differing: the parameters that differ, with their shifts estimated together; a joint's counts in its direction.
        frames: how far the second model has base and tool elsewhere, in length and in angle; of fitted frames only.
        remainder: None without posteriors.
        level: probability that anything is called different by chance.
    """

    parameters: tuple[ParameterDifference, ...]
    differing: tuple[Difference, ...]
    frames: tuple[Movement, ...]
    remainder: Remainder | None
    level: float


def parameter_differences(pair: ModelPair, level: float = LEVEL) -> ParameterDifferences:
    """Test which parameters of two models differ.

    By differences e of the parameters the second model has the tool elsewhere, by `d = J e`. Under posteriors of the
    covariances `C1` and `C2`, d is normal with the covariance `X1 C1 X1^T + X2 C2 X2^T`, where X are derivatives by all
    unknowns, the weights of a joint correction among them. So corrections may be of different kinds, and what no
    measurement determines counts for nothing. Base and tool are free where frames are fitted. The parameter whose
    shift alone explains most of d is tested, at the level over the number of parameters (Bonferroni); then the next
    beside it, until none is significant.

    Args:
        pair: the models.
        level: probability with which anything is called different that is not.
    """
    parameters = _side_by_side(pair)
    if any(model.uncertainty is None and not _is_drawn(model) for model in (pair.first, pair.second)):
        return ParameterDifferences(parameters, (), (), None, level)
    effects = ParameterEffects(pair)
    threshold = NormalDist().inv_cdf(1 - level / (2 * max(len(effects.tested), 1)))
    chosen: list[int] = []
    while float((scores := effects.scores(chosen)).abs().amax()) > threshold:
        chosen.append(int(scores.abs().argmax()))
    p = effects.remainder(chosen)
    tested = (_tested(effects, number, one, chosen, parameters) for number, one in enumerate(parameters))
    return ParameterDifferences(
        tuple(tested), *effects.differing(chosen), remainder=Remainder(p, p < level), level=level
    )


def _tested(
    effects: ParameterEffects,
    number: int,
    parameter: ParameterDifference,
    chosen: Sequence[int],
    parameters: Sequence[ParameterDifference],
) -> ParameterDifference:
    """Test a parameter beside those that differ, itself and its equals left out."""
    alike = effects.alike(number)
    estimate = effects.shift(number, [one for one in chosen if one not in (number, *alike)])
    if estimate is None:
        return parameter
    shift, deviation = estimate
    chance = math.erfc(abs(shift) / deviation / math.sqrt(2)) * len(effects.tested)
    factor = FACTORS[parameter.unit]
    return replace(
        parameter,
        shift=shift * factor,
        deviation=deviation * factor,
        p=min(chance, 1.0),
        alike=tuple(parameters[one].name for one in alike if one < len(parameters)),
    )


def _side_by_side(pair: ModelPair) -> tuple[ParameterDifference, ...]:
    """Values and their standard deviations, without tests."""
    space = ParameterSpace(as_drawn(pair.first))
    models = pair.first, pair.second
    values = [model.identified.dh.ravel() for model in models]
    known = [_deviations(model, space.arm_size) for model in models]
    parameters = []
    for number, parameter in enumerate(space.parameters[: space.arm_size]):
        unit, factor = SHOWN_UNITS[parameter.unit]
        first, second = (float(those[number]) * factor for those in values)
        own, other = (None if those is None else float(those[number]) * factor for those in known)
        parameters.append(ParameterDifference(parameter.name, unit, first, second, (own, other)))
    return tuple(parameters)


def _deviations(model: CalibratedModel, count: int) -> Tensor | None:
    """Standard deviations of the parameters of the arm; those of a robot as drawn are 0."""
    posterior = parameter_posterior(model)
    if posterior is not None:
        return posterior.standard_errors[:count]
    return torch.zeros(count, dtype=torch.float64) if _is_drawn(model) else None


def _is_drawn(model: CalibratedModel) -> bool:
    """Whether a model is the robot as drawn, which is what it is and has no uncertainty."""
    if model.network is not None or model.hybrid is not None:
        return False
    return bool(np.array_equal(model.identified.dh, as_drawn(model).dh))
