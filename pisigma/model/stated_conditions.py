"""A hybrid model under a given payload and temperature, instead of the usual ones."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.errors import ModelError
from pisigma.hybrid.arms import HybridArm
from pisigma.joint_correction.features import (
    AbstractFeatures,
    ConditionFeatures,
    FourierSeries,
    GravityTorques,
    SharedFeatures,
)
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.robot.description import Robot

MOST_SPREADS = 3.0
"""Conditions farther from the mean of the measured rows, in their standard deviations, were not measured."""


def under_stated_conditions(
    model: CalibratedModel, payload_kg: float | None = None, temperature_c: float | None = None
) -> CalibratedModel:
    """The same model as a function of the joint values alone, under conditions that were learned.

    With `ConditionFeatures` weights at fixed conditions are shifts of the joints, which go into the geometry's joint
    offsets, first harmonics, and gravity torques of the last row.

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
    known = () if arm is None else arm.correction.conditions
    for name in given:
        if arm is None or name not in known:
            knows = ", ".join(known) or "joint values only"
            raise ModelError(
                f"model '{model.name}' did not learn what {name} does; it knows {knows}. Calibrate with rows "
                f"measured at several values of {name} (a column of that name)."
            )
    assert arm is not None
    learned = next(chosen for chosen in arm.correction.features if isinstance(chosen, ConditionFeatures))
    usual = dict(zip(learned.names, learned.mean, strict=True))
    return replace(model, hybrid=_arm_under(model.name, arm, given), conditions={**usual, **given})


def _arm_under(name: str, arm: HybridArm, given: Mapping[str, float]) -> HybridArm:
    """The arm with a correction that has the effect of the conditions among its other weights."""
    own = arm.correction
    place = next(k for k, chosen in enumerate(own.features) if isinstance(chosen, ConditionFeatures))
    learned = own.features[place]
    assert isinstance(learned, ConditionFeatures)
    scaled = _scaled(name, learned, given)
    robot, count = own.robot, len(learned.names)
    weight = own.linear[place].detach()
    shift, sine, cosine = (weight[:, : 3 * count].view(-1, count, 3) * scaled[:, None]).sum(1).unbind(1)
    slides = ~torch.tensor(robot.revolute)
    kept = [
        (chosen, values.detach().clone())
        for chosen, values in zip(own.features, own.linear, strict=True)
        if not isinstance(chosen, ConditionFeatures)
    ]
    series = _weights_of(kept, FourierSeries(robot, 1), lambda other: isinstance(other, FourierSeries))
    harmonics = series.shape[1] // 2
    series[:, 0] += torch.where(slides, 0.0, sine)
    series[:, harmonics] += torch.where(slides, 0.0, cosine)
    if bool(slides.any()):
        joints = _weights_of(kept, SharedFeatures(robot, "joints"), lambda other: other.name == "joints")
        joints.diagonal().add_(torch.where(slides, sine, 0.0))
    if "payload_kg" in learned.names:
        x, y, z = learned.gravity
        falling = GravityTorques(robot, (x, y, z))
        torques = _weights_of(kept, falling, lambda other: other.describe() == falling.describe())
        torques[:, -4:] += weight[:, 3 * count :] * scaled[learned.names.index("payload_kg")]
    made = JointCorrection(robot, [chosen for chosen, _ in kept], own.orders)
    made.load_state_dict(
        {f"linear.{k}": values for k, (_, values) in enumerate(kept)}
        | {key: own.state_dict()[key] for key in ("weight", "bias", "fixed")}
    )
    made.requires_grad_(False)
    return replace(arm, hybrid=_shifted(arm.hybrid, shift), correction=made)


def _scaled(
    name: str, learned: ConditionFeatures, given: Mapping[str, float]
) -> Float64[Tensor, " conditions"]:
    """The conditions in standard deviations from their mean; 0 for those that are as usual.

    Raises:
        ModelError: one is far from all that were measured, not finite, or a payload below 0.
    """
    found = []
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
        found.append((value - mean) / spread)
    return torch.tensor(found, dtype=torch.float64)


def _weights_of(
    kept: list[tuple[AbstractFeatures, Tensor]],
    wanted: AbstractFeatures,
    fits: Callable[[AbstractFeatures], bool],
) -> Float64[Tensor, "dof columns"]:
    """Weights of the features that fit, to be changed in place; of the wanted ones, all 0, where none do."""
    for chosen, weights in kept:
        if fits(chosen):
            return weights
    kept.append((wanted, torch.zeros(wanted.used.shape, dtype=torch.float64)))
    return kept[-1][1]


def _shifted(robot: Robot, shift: Float64[Tensor, " dof"]) -> Robot:
    """The robot with joints that stand a little elsewhere: `q + shift` is commanded by q."""
    dh = robot.dh.copy()
    for row, turns, direction, value in zip(
        robot.joint_rows, robot.revolute, robot.directions, shift.tolist(), strict=True
    ):
        dh[row, 0 if turns else 1] += direction * value
    return robot.with_geometry(dh=dh)
