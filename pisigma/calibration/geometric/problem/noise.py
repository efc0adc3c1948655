"""What the residuals say of the noise, of repeated poses and of the prior."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation
from pisigma.calibration.geometric.problem.prior_sizes import PriorGroup, scaled_precision
from pisigma.estimation.loss import AbstractLoss
from pisigma.measurement.sensors.sensor import AbstractSensor

SMALLEST_NOISE = 1e-14
"""[m or rad] Floor of the estimated noise: what rounding does to a pose."""
ALWAYS_GOOD = 1e-10
"""[m or rad] Rows nearer to their prediction than this never count as wrong."""


UNDETERMINED = 1e-12
"""Share of the information of angles with which lengths are taken to determine what they do not see."""
LARGEST_DISAGREEMENT = 1e6
"""Angles of more than so many times their variance say nothing."""


@dataclass(frozen=True, eq=False)
class SensorSums:
    """What one sensor contributes at one point, before division by its noise's variance.

    Attributes:
        normal: `Σ w J J^T / sigma_row²` over its rows.
        descent: `Σ w J r / sigma_row²`.
        residual: measured minus predicted, 0 where nothing was measured [m or rad].
        distance: length of the residual over sigma_row, 0 where nothing was measured.
        measured: number of rows that were measured.
    """

    normal: Float64[Tensor, "active active"]
    descent: Float64[Tensor, " active"]
    residual: Float64[Tensor, "components rows"]
    distance: Float64[Tensor, " rows"]
    measured: int

    @property
    def rms(self) -> Float64[Tensor, ""]:
        """Root mean square of the residuals' lengths [m or rad]."""
        size: Tensor = torch.linalg.vector_norm(self.residual)
        return size / math.sqrt(max(self.measured, 1))


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
    noise: Float64[Tensor, " sensors"]
    repetition: Float64[Tensor, " sensors"]
    disagreement: Float64[Tensor, " sensors"]
    prior_scale: Float64[Tensor, " groups"]

    @staticmethod
    def without_noise(sums: tuple[SensorSums, ...]) -> "SensorView":
        """All sensors as if their values had a standard deviation of 1, the prior being as stated."""
        ones = sums[0].normal.new_ones(max(len(sums), len(PriorGroup)))
        sensors = ones[: len(sums)]
        return SensorView(sums, sensors, sensors, sensors, ones[: len(PriorGroup)])

    @cached_property
    def scales(self) -> Float64[Tensor, " sensors"]:
        """What distances are divided by for the loss."""
        return self.noise.clamp(min=ALWAYS_GOOD)

    @cached_property
    def variances(self) -> Float64[Tensor, " sensors"]:
        """What the sensors' sums are divided by."""
        return self.noise.square() * self.repetition * self.disagreement

    def scaled(
        self, precision: Float64[Tensor, " active"], group: Int64[Tensor, " active"]
    ) -> Float64[Tensor, " active"]:
        """1 / variance of parameters by the prior at its present scale."""
        return scaled_precision(precision, group, self.prior_scale)


def view_of(linearisation: Linearisation[Tensor]) -> SensorView:
    """The sensors' part of a linearisation that a `CalibrationProblem` made."""
    assert isinstance(linearisation.detail, SensorView)
    return linearisation.detail


def values_used(
    view: SensorView, covariance: Float64[Tensor, "active active"]
) -> Float64[Tensor, " sensors"]:
    """How many values of every sensor the parameters use up (Förstner 1979); the prior spares some."""
    used = [(sums.normal * covariance).sum() for sums in view.sums]
    return torch.stack(used) / view.variances


def loss_scale(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: SensorView,
    used: Float64[Tensor, " sensors"],
    refine: bool,
) -> Float64[Tensor, " sensors"]:
    """Standard deviation of every sensor's values, or factor of 1 or more on those that its rows give.

    `refine` uses all good rows instead of the median.
    """
    scales = []
    for k, sensor in enumerate(sensors):
        if sensor.certain:
            scales.append(torch.ones_like(used[k]))
            continue
        distance = view.sums[k].distance
        if view.sums[k].measured < len(distance):
            distance = distance[sensor.present]
        if refine:
            scale = loss.deviation(distance, sensor.components, used[k], view.scales[k])
        else:
            scale = loss.scale(distance, sensor.components, used[k])
        scales.append(scale.clamp(min=SMALLEST_NOISE if sensor.sigma is None else 1.0))
    return torch.stack(scales)


def rejecting(sensors: Sequence[AbstractSensor], losses: Sequence[AbstractLoss], view: SensorView) -> bool:
    """Say whether the loss rejects any row of a sensor."""
    of_each = zip(sensors, losses, view.sums, view.scales, strict=True)
    return any(
        bool((loss.weight(sums.distance / scale, sensor.components) == 0).any())
        for sensor, loss, sums, scale in of_each
    )


def renumbered(keys: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Numbers from 0 on, equal where the keys are equal."""
    numbers: Tensor = torch.unique(keys, return_inverse=True)[1]
    return numbers


def group_variance_ratio(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: SensorView,
    used: Float64[Tensor, " sensors"],
    pose: Int64[Tensor, " rows"] | None,
    configuration: Int64[Tensor, " rows"] | None = None,
) -> Float64[Tensor, " sensors"]:
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
        ratio = torch.ones_like(used[k])
        ratios.append(ratio)
        if sensor.certain:
            continue
        weight = loss.weight(sums.distance / view.scales[k], sensor.components) * sensor.present
        if sensor.sigma is not None:
            weight = torch.where(sensor.present, weight / sensor.sigma.square(), 0.0)
        square, values = _group_squares(sums.residual, weight, pose)
        if pose is not None:
            left = (values - used[k]).clamp(min=1.0)
            ratio = (square / left / view.noise[k].square()).clamp(min=1.0)
        if configuration is not None:
            shared, fewer = _group_squares(sums.residual, weight, configuration)
            larger = ((shared / fewer) / (square / values)).clamp(min=1.0)
            ratio = torch.where(square > 0, ratio * larger, ratio)
        ratios[-1] = ratio
    return torch.stack(ratios)


def angle_disagreement(
    sensors: Sequence[AbstractSensor],
    view: SensorView,
    held: Float64[Tensor, " active"],
    pull: Float64[Tensor, " active"],
) -> Float64[Tensor, " sensors"]:
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
    lengths = [sensor.unit != "rad" and not sensor.certain for sensor in sensors]
    if not any(angular) or not any(lengths):
        return torch.ones_like(view.noise)
    variance = view.noise.square() * view.repetition
    normals = [sums.normal / variance[k] for k, sums in enumerate(view.sums)]
    descents = [sums.descent / variance[k] for k, sums in enumerate(view.sums)]
    zero = torch.zeros_like(normals[0]), torch.zeros_like(pull)
    by_lengths, by_angles = (
        (
            sum((one for one, angle in zip(normals, angular, strict=True) if angle is which), zero[0]),
            sum((one for one, angle in zip(descents, angular, strict=True) if angle is which), zero[1]),
        )
        for which in (False, True)
    )
    systems = (by_lengths[0], by_lengths[1] + pull, *by_angles, held)
    factor = _angle_disagreement(*(value.cpu().numpy() for value in systems))
    return pull.new_tensor([factor if angle else 1.0 for angle in angular])


def _angle_disagreement(
    Q: Float64[np.ndarray, "active active"],
    lengths: Float64[np.ndarray, " active"],
    R: Float64[np.ndarray, "active active"],
    angles: Float64[np.ndarray, " active"],
    held: Float64[np.ndarray, " active"],
) -> float:
    """Return the factor: normal matrix and descent by lengths, the same by angles, and the prior."""
    A = Q + np.diag(held)
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
        return 1.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.exp(high)


def _group_squares(
    residual: Float64[Tensor, "components rows"],
    weight: Float64[Tensor, " rows"],
    group: Int64[Tensor, " rows"] | None,
) -> tuple[Float64[Tensor, ""], Int64[Tensor, ""]]:
    """Sum of the squared mean residuals of groups of rows, by weight, and of how many values it is."""
    components = residual.shape[0]
    if group is None:
        return (residual.square() * weight).sum(), (weight > 0).sum() * components
    groups = int(group.max()) + 1
    total = weight.new_zeros(groups).scatter_add(0, group, weight)
    summed = residual.new_zeros((components, groups)).index_add(1, group, residual * weight)
    squares = summed.square().sum(0) / total
    measured = total > 0
    return torch.where(measured, squares, 0.0).sum(), measured.sum() * components
