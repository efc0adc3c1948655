"""What the residuals say of the noise, of repeated poses and of the prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.identification.problem.least_squares import Linearisation
from pisigma.identification.problem.loss import AbstractLoss
from pisigma.sensors.sensor import AbstractSensor

SMALLEST_NOISE = 1e-14
"""[m or rad] Floor of the estimated noise: what rounding does to a pose."""
ALWAYS_GOOD = 1e-10
"""[m or rad] Rows nearer to their prediction than this never count as wrong."""


class PriorGroup(IntEnum):
    """Parameters whose errors are believed to be of one size, because they come from the same cause.

    Few groups, because only several parameters determine a size: one for every parameter (relevance vectors,
    Tipping 2001) fits the noise. Lengths that are drawn and that are not are apart, because joining them made
    weak data worse, while it made no difference whether d and a, or alpha and beta, are apart.
    """

    JOINT_OFFSET = 0
    """theta: where the zeros of the joints were set."""
    LENGTH = 1
    """d and a that are drawn: how long links are."""
    NO_LENGTH = 2
    """d and a drawn as 0, or shorter than their tolerance: how nearly axes meet or are in line."""
    BETWEEN_AXES = 3
    """alpha and beta: how square and parallel axes are."""


UNDETERMINED = 1e-12
"""Share of the information of angles with which lengths are taken to determine what they do not see."""
LARGEST_DISAGREEMENT = 1e6
"""Angles of more than so many times their variance say nothing."""
LEAST_EFFECTIVE = 0.1
"""The prior of a group of which the data determine less than so many parameters stays as it is."""
SMALLEST_PRIOR = 0.03
"""An estimated prior is not narrower than this share of the stated one."""


@dataclass(frozen=True, eq=False)
class SensorSums:
    """What one sensor contributes at one point, before division by its noise's variance.

    Attributes:
        normal: `Σ w J J^T / sigma_row²` over its rows.
        descent: `Σ w J r / sigma_row²`.
        residual: measured minus predicted, 0 where nothing was measured [m or rad].
        distance: length of the residual over sigma_row, 0 where nothing was measured.
        measured: number of rows of the problem that were measured.
    """

    normal: Float64[Tensor, "active active"]
    descent: Float64[Tensor, " active"]
    residual: Float64[Tensor, "components rows"]
    distance: Float64[Tensor, " rows"]
    measured: int

    @property
    def rms(self) -> float:
        """Root mean square of the residuals' lengths [m or rad]."""
        return float((self.residual.square().sum() / max(self.measured, 1)).sqrt())


def joined_sums(chunks: Sequence[SensorSums]) -> SensorSums:
    """Add up what a sensor contributes in chunks of rows, one behind the other."""
    first, *others = chunks
    if not others:
        return first
    return SensorSums(
        normal=torch.stack([sums.normal for sums in chunks]).sum(0),
        descent=torch.stack([sums.descent for sums in chunks]).sum(0),
        residual=torch.cat([sums.residual for sums in chunks], 1),
        distance=torch.cat([sums.distance for sums in chunks]),
        measured=first.measured,
    )


@dataclass(frozen=True, eq=False)
class SensorView:
    """All sensors at one point, with the noise they are believed to have.

    Attributes:
        sums: per sensor.
        noise: per sensor, its standard deviation [m or rad], or a factor of 1 or more where the rows give
            their own.
        repetition: per sensor, 1 or more: by how much repeats of a pose, and several targets in it, say less than
            so many poses, because what the model gets wrong there is the same in all of them.
        disagreement: per sensor, 1 or more: factor on the variance of angles with which they agree with the measured
            lengths; see `angle_disagreement`.
        prior_scale: of the prior's standard deviations, per group of parameters.
    """

    sums: tuple[SensorSums, ...]
    noise: tuple[float, ...]
    repetition: tuple[float, ...]
    disagreement: tuple[float, ...]
    prior_scale: tuple[float, ...] = (1.0,) * len(PriorGroup)

    def scale(self, sensor: int) -> float:
        """What distances are divided by for the loss."""
        return max(self.noise[sensor], ALWAYS_GOOD)

    def variance(self, sensor: int) -> float:
        """What a sensor's sums are divided by."""
        return self.noise[sensor] ** 2 * self.repetition[sensor] * self.disagreement[sensor]

    def scaled(self, precision: Float64[Tensor, " active"], group: Tensor) -> Float64[Tensor, " active"]:
        """1 / variance of parameters by the prior at its present scale."""
        return precision / precision.new_tensor([scale**2 for scale in self.prior_scale])[group]


def view_of(linearisation: Linearisation[Tensor]) -> SensorView:
    """The sensors' part of a linearisation that a `CalibrationProblem` made."""
    assert isinstance(linearisation.detail, SensorView)
    return linearisation.detail


def values_used(view: SensorView, covariance: Float64[Tensor, "active active"]) -> tuple[float, ...]:
    """How many values of every sensor the parameters use up (Förstner 1979); the prior spares some."""
    return tuple(
        float(sums.normal.flatten().dot(covariance.flatten())) / view.variance(k)
        for k, sums in enumerate(view.sums)
    )


def loss_scale(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: SensorView,
    used: Sequence[float],
    refine: bool,
) -> tuple[float, ...]:
    """Standard deviation of every sensor's values, or factor of 1 or more on those that its rows give.

    `refine` uses all good rows instead of the median.
    """
    scales = []
    for k, sensor in enumerate(sensors):
        if sensor.certain:
            scales.append(1.0)
            continue
        distance = view.sums[k].distance
        if view.sums[k].measured < len(distance):
            distance = distance[sensor.present]
        if refine:
            scale = loss.deviation(distance, sensor.components, used[k], view.scale(k))
        else:
            scale = loss.scale(distance, sensor.components, used[k])
        scales.append(max(scale, SMALLEST_NOISE if sensor.sigma is None else 1.0))
    return tuple(scales)


def renumbered(keys: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Numbers from 0 on, equal where the keys are equal."""
    numbers: Tensor = torch.unique(keys, return_inverse=True)[1]
    return numbers


def group_variance_ratio(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: SensorView,
    used: Sequence[float],
    pose: Int64[Tensor, " rows"] | None,
    configuration: Int64[Tensor, " rows"] | None = None,
) -> tuple[float, ...]:
    """Variance of the poses' mean residuals over that of independent rows (Kish 1965: design effect).

    Targets on one tool share what the model gets wrong with the joints; by how much the mean residuals of
    configurations vary more than those of poses comes on top, at most by the number of targets.

    Args:
        sensors: per sensor, which rows it saw.
        loss: weights the rows within a pose.
        view: residuals and noise.
        used: values that the parameters use up, per sensor; they come off the poses, not off their repeats.
        pose: number of every row's pose; None where none is repeated.
        configuration: number of every row's joint values and frame; None where none has several targets.
    """
    ratios = []
    for k, (sensor, sums) in enumerate(zip(sensors, view.sums, strict=True)):
        if sensor.certain:
            ratios.append(1.0)
            continue
        weight = loss.weight(sums.distance / view.scale(k), sensor.components) * sensor.present
        if sensor.sigma is not None:
            weight = torch.where(sensor.present, weight / sensor.sigma.square(), 0.0)
        square, values = _group_squares(sums.residual, weight, pose)
        ratio = 1.0
        if pose is not None:
            ratio = max(square / max(values - used[k], 1.0) / view.noise[k] ** 2, 1.0)
        if configuration is not None and square > 0:
            shared, fewer = _group_squares(sums.residual, weight, configuration)
            ratio *= max((shared / fewer) / (square / values), 1.0)
        ratios.append(ratio)
    return tuple(ratios)


def angle_disagreement(
    sensors: Sequence[AbstractSensor], view: SensorView, held: Float64[Tensor, " active"], pull: Tensor
) -> tuple[float, ...]:
    """Estimate by which factor the variance of measured angles is to be enlarged, per sensor.

    What the geometry does not explain of orientations, such as the wobble of a wrist, depends on the pose. Rows taken
    as independent then claim to determine the geometry far better than they do, and pull the predicted positions away
    from the measured ones. Let x be the parameters by lengths and prior alone, with the information A, and y those by
    angles too. Taking angles in moves predicted lengths by `(x - y)^T Q (x - y)`, Q being the information of the
    lengths alone, where `tr(Q (cov x - cov y))` is expected. The factor, 1 or more, makes both equal; it is the moment
    estimator of random-effects meta-analysis (DerSimonian and Laird 1986, Controlled Clinical Trials 7(3), 177-188),
    with the cost of predicted lengths as its weight.

    Args:
        sensors: the sensors.
        view: normal equations and noise.
        held: the prior's precision of every free parameter.
        pull: what the prior adds to the descent.
    """
    angular = [sensor.unit == "rad" and not sensor.certain for sensor in sensors]
    if not any(angular) or all(
        sensor.certain or angle for sensor, angle in zip(sensors, angular, strict=True)
    ):
        return (1.0,) * len(sensors)
    Q, R = np.zeros((2, len(held), len(held)))
    lengths, angles = pull.cpu().numpy().copy(), np.zeros(len(held))
    for k, (sums, angle) in enumerate(zip(view.sums, angular, strict=True)):
        variance = view.noise[k] ** 2 * view.repetition[k]
        normal, descent = sums.normal.cpu().numpy() / variance, sums.descent.cpu().numpy() / variance
        if angle:
            R += normal
            angles += descent
        else:
            Q += normal
            lengths += descent
    A = Q + np.diag(held.cpu().numpy())
    scale = (A + R).diagonal()
    scale = 1 / np.sqrt(np.where(scale > 0, scale, 1.0))
    root = np.linalg.cholesky(A * scale * scale[:, None] + UNDETERMINED * np.eye(len(scale)))
    white = np.linalg.inv(root) * scale
    # in these coordinates A is the identity and R diagonal
    gain, axes = np.linalg.eigh(white @ R @ white.T)
    white = axes.T @ white
    Q, lengths, angles = white @ Q @ white.T, white @ lengths, white @ angles

    def excess(logarithm: float) -> float:
        """By what share angles of so much more variance move the lengths too far."""
        share = gain.clip(0.0) / (gain.clip(0.0) + math.exp(logarithm))
        moved = share * lengths - (1 - share) * angles * math.exp(-logarithm)
        return float(moved @ Q @ moved) - float(Q.diagonal() @ share)

    low, high = 0.0, math.log(LARGEST_DISAGREEMENT)
    if excess(low) <= 0:
        return (1.0,) * len(sensors)
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return tuple(math.exp(high) if angle else 1.0 for angle in angular)


def _group_squares(
    residual: Float64[Tensor, "components rows"],
    weight: Float64[Tensor, " rows"],
    group: Int64[Tensor, " rows"] | None,
) -> tuple[float, int]:
    """Sum of the squared mean residuals of groups of rows, by weight, and of how many values it is."""
    if group is None:
        return float((residual.square() * weight).sum()), int((weight > 0).sum()) * len(residual)
    groups = int(group.max()) + 1
    total = weight.new_zeros(groups).index_add(0, group, weight)
    summed = weight.new_zeros((len(residual), groups)).index_add(1, group, residual * weight)
    measured = total > 0
    return float((summed[:, measured].square().sum(0) / total[measured]).sum()), int(measured.sum()) * len(
        residual
    )


def prior_group_of(column: str, drawn: bool) -> int:
    """The group of a parameter whose prior is sized by the data.

    Args:
        column: "theta", "d", "a", "alpha" or "beta"; of others, which have no prior, any group will do.
        drawn: whether its nominal value is larger than its tolerance.
    """
    if column in ("d", "a"):
        return PriorGroup.LENGTH if drawn else PriorGroup.NO_LENGTH
    return PriorGroup.BETWEEN_AXES if column in ("alpha", "beta") else PriorGroup.JOINT_OFFSET


def effective_parameters(
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    view: SensorView,
    covariance: Float64[Tensor, "active active"],
) -> tuple[float, ...]:
    """How many parameters with a prior the data determine, per group: each counts by how much of it they do.

    `γ = Σ (1 - variance after / variance before)` of MacKay 1992, Neural Computation 4(3), eq. 4.5.

    Args:
        precision: 1 / variance as the prior states it, 0 where it says nothing.
        group: every parameter's group.
        view: the scale of the prior.
        covariance: of the parameters.
    """
    share = (1 - view.scaled(precision, group) * covariance.diagonal()) * (precision > 0)
    return _group_totals(share, group)


def _group_totals(values: Float64[Tensor, " active"], group: Int64[Tensor, " active"]) -> tuple[float, ...]:
    """Sum of the parameters' values per group of the prior."""
    totals = np.bincount(group.cpu().numpy(), values.cpu().numpy(), len(PriorGroup))
    return tuple(totals.tolist())


def prior_scales(
    off: Float64[Tensor, " active"],
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    view: SensorView,
    covariance: Float64[Tensor, "active active"],
    floor: float = 1.0,
) -> tuple[float, ...]:
    """How many times as large as stated the parameters' errors turn out, per group of parameters.

    MacKay's update (1992, Neural Computation 4(3), eq. 4.7) with the `effective_parameters` of every group.

    Args:
        off: distance of the parameters from their nominal values [m or rad].
        precision: 1 / variance as the prior states it, 0 where it says nothing.
        group: every parameter's group.
        view: the scale of the prior so far.
        covariance: of the parameters.
        floor: smallest answer; 1 where smaller errors than stated do not tighten the prior.
    """
    squares = _group_totals(off.square() * precision, group)
    least = 1.0 if floor == 1.0 else LEAST_EFFECTIVE
    effective = effective_parameters(precision, group, view, covariance)
    return tuple(
        max(off_square / count, floor**2) ** 0.5 if count > least else now
        for count, off_square, now in zip(effective, squares, view.prior_scale, strict=True)
    )
