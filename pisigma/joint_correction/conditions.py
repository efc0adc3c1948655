"""Feature for the effects of payload and temperature on the joints, and corrections under fixed conditions."""

from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np
import torch
from jaxtyping import Float, Float64
from pydantic import Field
from torch import Tensor

from pisigma.joint_correction.feature import (
    AbstractFeature,
    Feature,
    FeatureOptions,
    FeatureSection,
    scaled_joints,
)
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import Direction, GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.joint_torques import JointTorques
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.measurement.conditions import JointState
from pisigma.robot.description import Robot


class ConditionSection(FeatureSection):
    """Section of conditions in the description of a model."""

    name: Literal["conditions"]
    names: Annotated[tuple[Literal["payload_kg", "temperature_c"], ...], Field(min_length=1)]
    mean: tuple[float, ...]
    spread: tuple[float, ...]
    measured: tuple[tuple[float, float], ...]
    gravity: Direction


class ConditionFeatures(AbstractFeature):
    """Payload and temperature, each times 1, sine and cosine of the joint value (prismatic: scaled joint value).

    A condition is expressed in standard deviations from its mean over the measured rows, so that missing
    conditions are treated as their means. The payload also multiplies the gravity torques of a mass in the last row's
    frame; its effect is proportional, even beyond the measured values. Beyond the lowest and highest measured
    temperature, the correction is constant, because the thermal expansion of an arm is not linear and its extrapolation
    would soon increase the errors.

    Attributes:
        names: names of the conditions.
        mean: means over the measured rows [kg, deg C].
        spread: standard deviations over the measured rows.
        measured: lowest and highest measured value of every condition.
    """

    name = "conditions"
    section = ConditionSection
    usually_zero = True

    def __init__(
        self,
        robot: Robot,
        names: Sequence[str],
        mean: Sequence[float],
        spread: Sequence[float],
        measured: Sequence[tuple[float, float]],
        gravity: Direction = (0.0, 0.0, -1.0),
    ) -> None:
        """Create the feature for the given conditions.

        Raises:
            ValueError: there is no condition, one does not vary, or a mean is outside the measured values.
        """
        super().__init__(robot)
        if not names or not len(names) == len(mean) == len(spread) or min(spread) <= 0:
            raise ValueError(
                f"expected names, means and positive spreads of conditions, got {tuple(names)}, {tuple(mean)}, "
                f"{tuple(spread)}."
            )
        measured = tuple((low, high) for low, high in measured)
        if len(measured) != len(names) or any(
            not low <= middle <= high for middle, (low, high) in zip(mean, measured, strict=False)
        ):
            raise ValueError(
                f"expected a lowest and a highest measured value around every mean, got {measured} around "
                f"{tuple(mean)}."
            )
        self.names, self.mean, self.spread, self.measured = tuple(names), tuple(mean), tuple(spread), measured
        self._torques = GravityTorques(robot, gravity)
        self.gravity = self._torques.gravity
        loaded = 4 if "payload_kg" in self.names else 0
        self.used = torch.ones(robot.dof, 3 * len(self.names) + loaded, dtype=torch.bool)
        group = [k for k in range(len(self.names)) for _ in range(3)]
        group += [self.names.index("payload_kg")] * 4 if loaded else []
        self.group = torch.tensor(group).expand(self.used.shape)
        self.group_names = self.names

    @classmethod
    def candidates(
        cls, robot: Robot, options: FeatureOptions, state: JointState
    ) -> tuple["ConditionFeatures", ...]:
        """Return the feature if a condition varies, otherwise an empty tuple."""
        if not options.varying_conditions:
            return ()
        values = torch.stack([state.conditions[name] for name in options.varying_conditions], 1)
        mean, spread = values.mean(0).tolist(), values.std(0).tolist()
        measured = [(float(low), float(high)) for low, high in zip(*values.aminmax(dim=0), strict=True)]
        return (
            ConditionFeatures(robot, options.varying_conditions, mean, spread, measured, options.gravity),
        )

    def columns(self, state: JointState) -> Float[Tensor, "*batch dof columns"]:
        """Return products of conditions and functions of the joint values; 0 for mean, missing or NaN conditions."""
        if not any(name in state.conditions for name in self.names):
            return state.q.new_zeros((*state.q.shape, self.column_count))
        return self._products(state, self.scaled_conditions(self._stated(state)))

    def unstated_covariance_root(
        self, state: JointState, weight: Float64[Tensor, "dof columns"]
    ) -> Float[Tensor, "*batch dof sources"]:
        """Return the effects of a standard deviation of unstated conditions, and of a temperature beyond the measured.

        The latter is the difference between the proportional effect and the constant correction.
        """
        stated = self._stated(state)
        beyond = self._scaled(stated) - self.scaled_conditions(stated)
        off = torch.where(torch.isfinite(stated), beyond, 1.0)
        products = [self._products(state, each) * weight for each in torch.diag_embed(off).unbind(-2)]
        return torch.stack(products, -1).sum(-2)

    def _stated(self, state: JointState) -> Float[Tensor, "*batch conditions"]:
        """Return the conditions of every row [kg, deg C]; NaN if it does not state one."""
        missing = torch.full_like(state.q[..., 0], torch.nan)
        return torch.stack([state.conditions.get(name, missing).to(state.q) for name in self.names], -1)

    def _products(
        self, state: JointState, scaled: Float[Tensor, "*batch conditions"]
    ) -> Float[Tensor, "*batch dof columns"]:
        """Return products of scaled conditions and functions of the joint values."""
        q = state.q
        turning = torch.tensor(self.robot.revolute, device=q.device)
        sine = torch.where(turning, q.sin(), scaled_joints(self.robot, q))
        cosine = torch.where(turning, q.cos(), torch.zeros_like(q))
        own = torch.stack([torch.ones_like(q), sine, cosine], -1)
        columns = [own * scaled[..., k, None, None] for k in range(len(self.names))]
        if "payload_kg" in self.names:
            torques = self._torques.columns(state)[..., -4:]
            columns.append(torques * scaled[..., self.names.index("payload_kg"), None, None])
        return torch.cat(columns, -1)

    def scaled_conditions(
        self, stated_conditions: Float[Tensor, "*batch conditions"]
    ) -> Float[Tensor, "*batch conditions"]:
        """Return conditions [kg, deg C] in standard deviations from their means; 0 for NaN.

        A temperature beyond the measured values is replaced by the nearest measured value.
        """
        low, high = stated_conditions.new_tensor(self.measured).unbind(-1)
        kept = torch.tensor([name == "temperature_c" for name in self.names], device=stated_conditions.device)
        inside = torch.where(kept, stated_conditions.clamp(low, high), stated_conditions)
        scaled = self._scaled(inside)
        return torch.where(torch.isfinite(scaled), scaled, 0.0)

    def _scaled(self, values: Float[Tensor, "*batch conditions"]) -> Float[Tensor, "*batch conditions"]:
        return (values - values.new_tensor(self.mean)) / values.new_tensor(self.spread)


def learned_conditions(correction: JointCorrection) -> ConditionFeatures | None:
    """Return the `ConditionFeatures` of a correction; None if it has no such feature."""
    return next((own for own in correction.features if isinstance(own, ConditionFeatures)), None)


def at_conditions(
    correction: JointCorrection, scaled_conditions: Float64[Tensor, " conditions"]
) -> tuple[JointCorrection, Float64[Tensor, " dof"]]:
    """Convert a correction at fixed conditions to a correction that depends only on the joint values.

    At fixed conditions, `ConditionFeatures` are offsets of the joints, first harmonics, and gravity torques of the last
    row; these are added to the weights of the other features.

    Args:
        correction: correction with `ConditionFeatures`.
        scaled_conditions: conditions in standard deviations from their means.

    Returns:
        The correction without `ConditionFeatures`, and the remaining offset of every joint [rad or m].
    """
    robot = correction.robot
    kept, found = _without(correction, ConditionFeatures)
    assert found is not None
    learned, weight = found
    count = len(learned.names)
    shift, sine, cosine = (
        (weight[:, : 3 * count].view(-1, count, 3) * scaled_conditions[:, None]).sum(1).unbind(1)
    )
    slides = ~torch.tensor(robot.revolute)
    series = _weights_of(kept, FourierSeries(robot, 1), lambda other: isinstance(other, FourierSeries))
    harmonics = series.shape[1] // 2
    # Columns of a series are all sines, then all cosines; the first column of each kind is the first harmonic.
    series[:, 0] += torch.where(slides, 0.0, sine)
    series[:, harmonics] += torch.where(slides, 0.0, cosine)
    if bool(slides.any()):
        joints = _weights_of(kept, ScaledJoints(robot), lambda other: isinstance(other, ScaledJoints))
        joints.diagonal().add_(torch.where(slides, sine, 0.0))
    if "payload_kg" in learned.names:
        falling = GravityTorques(robot, learned.gravity)
        torques = _weights_of(kept, falling, lambda other: other.describe() == falling.describe())
        torques[:, -4:] += weight[:, 3 * count :] * scaled_conditions[learned.names.index("payload_kg")]
    return _with_features(correction, kept), shift


def with_modelled_torques(correction: JointCorrection) -> JointCorrection:
    """Convert a correction to one without `JointTorques` that is the same where no torques are stated."""
    kept, torques = _without(correction, JointTorques)
    if torques is not None:
        feature, values = torques
        falling = GravityTorques(correction.robot, feature.gravity)
        weights = _weights_of(kept, falling, lambda other: other.describe() == falling.describe())
        weights += feature.gravity_weights(values)
    return correction if torques is None else _with_features(correction, kept)


def at_torques(
    correction: JointCorrection, torques: Float64[np.ndarray, " dof"]
) -> tuple[JointCorrection, Float64[Tensor, " dof"]]:
    """Convert a correction with `JointTorques` at fixed torques [Nm or N] to one without them.

    Returns:
        The correction, and the remaining offset of every joint [rad or m].
    """
    kept, learned = _without(correction, JointTorques)
    assert learned is not None
    feature, values = learned
    return _with_features(correction, kept), feature.deflections(values, torques)


def learned_torques(correction: JointCorrection) -> JointTorques | None:
    """Return the `JointTorques` of a correction; None if it has none."""
    return next((own for own in correction.features if isinstance(own, JointTorques)), None)


_Kept = list[tuple[AbstractFeature, Tensor]]
"""Features with their weights."""


def _without(
    correction: JointCorrection, kind: type[Feature]
) -> tuple[_Kept, tuple[Feature, Float64[Tensor, "dof columns"]] | None]:
    """Return copies of all weights, with those of the feature of a given class separate."""
    kept: _Kept = []
    learned = None
    for feature, values in zip(correction.features, correction.linear, strict=True):
        if isinstance(feature, kind):
            learned = feature, values.detach()
        else:
            kept.append((feature, values.detach().clone()))
    return kept, learned


def _with_features(correction: JointCorrection, kept: _Kept) -> JointCorrection:
    """Return a correction with other features, and the same product units."""
    made = JointCorrection(correction.robot, [feature for feature, _ in kept], correction.orders)
    made.load_state_dict(
        {f"linear.{k}": values for k, (_, values) in enumerate(kept)}
        | {key: correction.state_dict()[key] for key in ("weight", "bias", "fixed")}
    )
    made.requires_grad_(False)
    return made


def _weights_of(
    kept: _Kept,
    wanted: AbstractFeature,
    fits: Callable[[AbstractFeature], bool],
) -> Float64[Tensor, "dof columns"]:
    """Return the weights of the first feature that fits, to be changed in place; if no feature fits, add `wanted`."""
    for feature, weights in kept:
        if fits(feature):
            return weights
    kept.append((wanted, torch.zeros(wanted.used.shape, dtype=torch.float64)))
    return kept[-1][1]
