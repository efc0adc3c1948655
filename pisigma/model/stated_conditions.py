"""A hybrid model under a stated payload and temperature; and which of these lie beyond the measured ones."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.files.errors import ModelError
from pisigma.joint_correction.conditions import ConditionFeatures, at_conditions, learned_conditions
from pisigma.measurement.conditions import conditions_of
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.rules import TEMPERATURES
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot

_BEYOND = {
    "payload_kg": "what the payload does is continued in proportion",
    "temperature_c": "the correction stays that of the nearest measured temperature",
}
"""What a model does beyond the measured values of a condition."""


def under_stated_conditions(
    model: CalibratedModel, payload_kg: float | None = None, temperature_c: float | None = None
) -> CalibratedModel:
    """The same model as a function of the joint values alone, under conditions that were learned.

    See `pisigma.joint_correction.conditions.at_conditions`; shifts of the joints go into the geometry's joint offsets.
    Of conditions beyond the measured ones `condition_warnings` warns.

    Args:
        model: a hybrid one, calibrated on rows that state what is given here.
        payload_kg: what the robot carries [kg]; as usual if None.
        temperature_c: of the robot [deg C]; as usual if None.

    Raises:
        ModelError: the model did not learn what a stated condition does, or its value makes no sense.
    """
    given = {"payload_kg": payload_kg, "temperature_c": temperature_c}
    stated = {name: value for name, value in given.items() if value is not None}
    if not stated:
        return model
    arm, learned = model.hybrid, _learned(model)
    names = () if learned is None else learned.names
    for name, value in stated.items():
        if name not in names:
            knows = ", ".join(names) or "joint values only"
            raise ModelError(
                f"model '{model.name}' did not learn what {name} does; it knows {knows}. Calibrate with rows "
                f"measured at several values of {name} (a column of that name)."
            )
        low, high = TEMPERATURES if name == "temperature_c" else (0.0, math.inf)
        if not math.isfinite(value) or not low <= value <= high:
            wanted = "a mass of 0 or more" if high == math.inf else f"a temperature of {low:g} to {high:g}"
            raise ModelError(f"model '{model.name}': {name}={value:g} was stated; give {wanted}.")
    assert arm is not None
    assert learned is not None
    usual = dict(zip(learned.names, learned.mean, strict=True))
    values = torch.tensor([{**usual, **stated}[name] for name in learned.names], dtype=torch.float64)
    correction, shift = at_conditions(arm.correction, learned.scaled(values))
    under = replace(arm, robot=_shifted(arm.robot, shift), correction=correction)
    measured = {
        name: ends for name, ends in zip(learned.names, learned.measured, strict=True) if name in stated
    }
    return replace(model, hybrid=under, conditions={**usual, **stated}, measured_conditions=measured)


def condition_warnings(model: CalibratedModel, rows: Measurements | None = None) -> tuple[str, ...]:
    """Warn of conditions beyond those that the model was calibrated under: a sentence for each.

    Args:
        model: of any kind; only a hybrid learns what conditions do.
        rows: whose conditions are meant; None for those that the model was put under.
    """
    if rows is None:
        stated = [
            (name, *ends, torch.tensor([model.conditions[name]], dtype=torch.float64))
            for name, ends in model.measured_conditions.items()
        ]
    else:
        learned = _learned(model)
        if learned is None:
            return ()
        columns = conditions_of(rows, learned.names).unbind(1)
        stated = [
            (name, low, high, values)
            for name, (low, high), values in zip(learned.names, learned.measured, columns, strict=True)
        ]
    return tuple(sentence for one in stated for sentence in _warning(*one, model.name, rows is None))


def _warning(
    name: str, low: float, high: float, values: Float64[Tensor, " rows"], model: str, single: bool
) -> Sequence[str]:
    """The sentence on one condition; none where all values were measured or are not stated."""
    slack = 1e-9 * max(abs(low), abs(high), 1.0)
    beyond = values[(values < low - slack) | (values > high + slack)]
    if not len(beyond):
        return ()
    least, most = float(beyond.min()), float(beyond.max())
    span = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}"
    what = f"{name} {span}" if single else f"{len(beyond)} of {len(values)} rows have {name} {span}, which"
    return (
        f"{what} lies beyond the {low:.4g} to {high:.4g} that {model} was calibrated at: {_BEYOND[name]}.",
    )


def _learned(model: CalibratedModel) -> ConditionFeatures | None:
    return None if model.hybrid is None else learned_conditions(model.hybrid.correction)


def _shifted(robot: Robot, shift: Float64[Tensor, " dof"]) -> Robot:
    """The robot with joints that stand a little elsewhere: `q + shift` is commanded by q."""
    dh = robot.dh.copy()
    for row, turns, direction, value in zip(
        robot.joint_rows, robot.revolute, robot.directions, shift.tolist(), strict=True
    ):
        dh[row, 0 if turns else 1] += direction * value
    return robot.with_geometry(dh=dh)
