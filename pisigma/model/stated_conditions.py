"""A hybrid model under a given payload and temperature, instead of the usual ones."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import ModelError
from pisigma.joint_correction.conditions import ConditionFeatures, at_conditions, learned_conditions
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot

MOST_SPREADS = 3.0
"""Conditions farther from the mean of the measured rows, in their standard deviations, were not measured."""


def under_stated_conditions(
    model: CalibratedModel, payload_kg: float | None = None, temperature_c: float | None = None
) -> CalibratedModel:
    """The same model as a function of the joint values alone, under conditions that were learned.

    See `pisigma.joint_correction.conditions.at_conditions`; shifts of the joints go into the geometry's joint offsets.

    Args:
        model: a hybrid one, calibrated on rows that state what is given here.
        payload_kg: what the robot carries [kg]; as usual if None.
        temperature_c: of the robot [deg C]; as usual if None.

    Raises:
        ModelError: the model did not learn what a given condition does, or not near the given value.
    """
    stated = {"payload_kg": payload_kg, "temperature_c": temperature_c}
    given = {name: value for name, value in stated.items() if value is not None}
    if not given:
        return model
    arm = model.hybrid
    learned = None if arm is None else learned_conditions(arm.correction)
    names = () if learned is None else learned.names
    for name in given:
        if name not in names:
            knows = ", ".join(names) or "joint values only"
            raise ModelError(
                f"model '{model.name}' did not learn what {name} does; it knows {knows}. Calibrate with rows "
                f"measured at several values of {name} (a column of that name)."
            )
    assert arm is not None
    assert learned is not None
    usual = dict(zip(learned.names, learned.mean, strict=True))
    correction, shift = at_conditions(arm.correction, _scaled(model.name, learned, given))
    under = replace(arm, robot=_shifted(arm.robot, shift), correction=correction)
    return replace(model, hybrid=under, conditions={**usual, **given})


def _scaled(
    name: str, learned: ConditionFeatures, given: Mapping[str, float]
) -> Float64[Tensor, " conditions"]:
    """The conditions in standard deviations from their mean; 0 for those that are as usual.

    Raises:
        ModelError: one is far from all that were measured, not finite, or a payload below 0.
    """
    result = []
    for known, mean, spread in zip(learned.names, learned.mean, learned.spread, strict=True):
        value = given.get(known, mean)
        low, high = mean - MOST_SPREADS * spread, mean + MOST_SPREADS * spread
        if known == "payload_kg":
            low = max(low, 0.0)
        if not low <= value <= high:  # NaN neither
            raise ModelError(
                f"model '{name}': {known}={value:g} is not near the measured values, {mean:.4g} on average with a "
                f"standard deviation of {spread:.4g}; give {low:.4g} to {high:.4g}, or calibrate with rows "
                "measured there."
            )
        result.append((value - mean) / spread)
    return torch.tensor(result, dtype=torch.float64)


def _shifted(robot: Robot, shift: Float64[Tensor, " dof"]) -> Robot:
    """The robot with joints that stand a little elsewhere: `q + shift` is commanded by q."""
    dh = robot.dh.copy()
    for row, turns, direction, value in zip(
        robot.joint_rows, robot.revolute, robot.directions, shift.tolist(), strict=True
    ):
        dh[row, 0 if turns else 1] += direction * value
    return robot.with_geometry(dh=dh)
