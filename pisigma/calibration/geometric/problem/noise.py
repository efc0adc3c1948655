"""Estimate the noise of sensors from residuals: robust scales, rows of repeated poses, and angles against lengths."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import Linearisation
from pisigma.calibration.geometric.problem.prior_scales import PriorGroup, scaled_precision
from pisigma.estimation.loss import AbstractLoss
from pisigma.measurement.groups import groups_of_equal_joints
from pisigma.measurement.sensors.sensor import AbstractSensor

SMALLEST_NOISE = 1e-14
"""Lower bound of the estimated noise [m or rad]: rounding errors of a pose."""
ALWAYS_GOOD = 1e-10
"""Residual below which a row is never an outlier [m or rad]."""


UNDETERMINED = 1e-12
"""Information, relative to the total, that is added in directions that lengths do not determine."""
_MAX_DISAGREEMENT = 1e6
"""Largest factor on the variance of angles, with which angles have no effect."""


@dataclass(frozen=True, eq=False)
class SensorContribution:
    """Contribution of a sensor to the normal equations at a point, before division by the variance of its noise.

    Attributes:
        normal: `Σ w J J^T / sigma_row²` over the rows of the sensor.
        descent: `Σ w J r / sigma_row²`, the right-hand side of the normal equations.
        residual: measured minus predicted values [m or rad]; 0 in rows without a value.
        residual_length: length of the residual divided by sigma_row; 0 in rows without a value.
        measured_rows: number of measured rows.
    """

    normal: Float64[Tensor, "active active"]
    descent: Float64[Tensor, " active"]
    residual: Float64[Tensor, "components rows"]
    residual_length: Float64[Tensor, " rows"]
    measured_rows: int

    @property
    def rms(self) -> Float64[Tensor, ""]:
        """Root mean square length of the residuals [m or rad]."""
        size: Tensor = torch.linalg.vector_norm(self.residual)
        return size / math.sqrt(max(self.measured_rows, 1))


def joined_contributions(chunks: Sequence[SensorContribution]) -> SensorContribution:
    """Return the sum of the contributions of a sensor in successive chunks of rows."""
    first, *others = chunks
    if not others:
        return first
    return SensorContribution(
        normal=torch.stack([part.normal for part in chunks]).sum(0),
        descent=torch.stack([part.descent for part in chunks]).sum(0),
        residual=torch.cat([part.residual for part in chunks], 1),
        residual_length=torch.cat([part.residual_length for part in chunks]),
        measured_rows=first.measured_rows,
    )


@dataclass(frozen=True, eq=False)
class ContributionsAndNoise:
    """Contributions of all sensors at a point, with their estimated noise.

    Attributes:
        contributions: contributions per sensor.
        noise: standard deviation per sensor [m or rad], or a factor >= 1 on the standard deviations that the rows
            state.
        repeat_variance_factor: factor >= 1 on the variance per sensor, because repeats of a pose and several targets in
            it share the errors of the model and are not independent; see `group_variance_ratio`.
        angle_variance_factor: factor >= 1 on the variance per sensor that makes angles agree with the measured lengths;
            see `angle_variance_factor`.
        prior_scale: scale of the prior standard deviations, per group of parameters.
    """

    contributions: tuple[SensorContribution, ...]
    noise: Float64[Tensor, " sensors"]
    repeat_variance_factor: Float64[Tensor, " sensors"]
    angle_variance_factor: Float64[Tensor, " sensors"]
    prior_scale: Float64[Tensor, " groups"]

    @staticmethod
    def without_noise(contributions: tuple[SensorContribution, ...]) -> "ContributionsAndNoise":
        """Return the contributions with standard deviations of 1 and the stated prior."""
        ones = contributions[0].normal.new_ones(max(len(contributions), len(PriorGroup)))
        sensors = ones[: len(contributions)]
        return ContributionsAndNoise(contributions, sensors, sensors, sensors, ones[: len(PriorGroup)])

    @cached_property
    def loss_scales(self) -> Float64[Tensor, " sensors"]:
        """Scale of the distances of every sensor, for the loss."""
        return self.noise.clamp(min=ALWAYS_GOOD)

    @cached_property
    def variances(self) -> Float64[Tensor, " sensors"]:
        """Variance of the values of every sensor, including all factors."""
        return self.noise.square() * self.repeat_variance_factor * self.angle_variance_factor

    def scaled_precision(
        self, precision: Float64[Tensor, " active"], group: Int64[Tensor, " active"]
    ) -> Float64[Tensor, " active"]:
        """Return the prior precision of parameters with the current scale."""
        return scaled_precision(precision, group, self.prior_scale)


def contributions_and_noise_of(linearisation: Linearisation[Tensor]) -> ContributionsAndNoise:
    """Return the contributions of the sensors in a linearisation of a `CalibrationProblem`."""
    assert isinstance(linearisation.problem_data, ContributionsAndNoise)
    return linearisation.problem_data


def effective_parameters_by_sensor(
    view: ContributionsAndNoise, covariance: Float64[Tensor, "active active"]
) -> Float64[Tensor, " sensors"]:
    """Compute the effective number of parameters that are estimated from every sensor's values (Förstner 1979)."""
    used = [(part.normal * covariance).sum() for part in view.contributions]
    return torch.stack(used) / view.variances


def noise_scales(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: ContributionsAndNoise,
    effective_parameters: Float64[Tensor, " sensors"],
    use_all_good_rows: bool,
) -> Float64[Tensor, " sensors"]:
    """Estimate the standard deviation of every sensor's values, or a factor >= 1 on stated standard deviations.

    Args:
        sensors: the sensors.
        loss: loss function, which defines the estimators.
        view: residuals and current noise.
        effective_parameters: effective number of parameters per sensor.
        use_all_good_rows: whether to use all rows without outliers instead of the median.
    """
    scales = []
    for k, sensor in enumerate(sensors):
        if sensor.are_values_given:
            scales.append(torch.ones_like(effective_parameters[k]))
            continue
        distance = view.contributions[k].residual_length
        if view.contributions[k].measured_rows < len(distance):
            distance = distance[sensor.present]
        if use_all_good_rows:
            scale = loss.sigma(distance, sensor.components, effective_parameters[k], view.loss_scales[k])
        else:
            scale = loss.scale(distance, sensor.components, effective_parameters[k])
        scales.append(scale.clamp(min=SMALLEST_NOISE if sensor.sigma is None else 1.0))
    return torch.stack(scales)


def rejects_rows(
    sensors: Sequence[AbstractSensor], losses: Sequence[AbstractLoss], view: ContributionsAndNoise
) -> bool:
    """Return whether any loss gives a row a weight of 0."""
    of_each = zip(sensors, losses, view.contributions, view.loss_scales, strict=True)
    return any(
        bool((loss.weight(part.residual_length / scale, sensor.components) == 0).any())
        for sensor, loss, part, scale in of_each
    )


def renumber(keys: Int64[Tensor, " rows"]) -> Int64[Tensor, " rows"]:
    """Return an index from 0 for every key, equal for equal keys."""
    numbers: Tensor = torch.unique(keys, return_inverse=True)[1]
    return numbers


def group_variance_ratio(
    sensors: Sequence[AbstractSensor],
    loss: AbstractLoss,
    view: ContributionsAndNoise,
    effective_parameters: Float64[Tensor, " sensors"],
    pose: Int64[Tensor, " rows"] | None,
    configuration: Int64[Tensor, " rows"] | None = None,
) -> Float64[Tensor, " sensors"]:
    """Compute the ratio of the variances of mean residuals of poses and of independent rows (design effect, Kish 1965).

    Targets on one tool share the model's errors of the joints. Therefore the ratio is multiplied by the ratio of the
    variances of mean residuals of configurations and of poses, if that is larger than 1.

    Args:
        sensors: the sensors, with the rows that have values.
        loss: loss function for the weights of rows within a pose.
        view: residuals and noise.
        effective_parameters: effective number of parameters per sensor, which reduces the degrees of freedom of the
            poses.
        pose: index of every row's pose; None if no pose is repeated.
        configuration: index of every row's joint values and frame; None if no configuration has several targets.
    """
    ratios = []
    for k, (sensor, part) in enumerate(zip(sensors, view.contributions, strict=True)):
        ratio = torch.ones_like(effective_parameters[k])
        ratios.append(ratio)
        if sensor.are_values_given:
            continue
        weight = loss.weight(part.residual_length / view.loss_scales[k], sensor.components) * sensor.present
        if sensor.sigma is not None:
            weight = torch.where(sensor.present, weight / sensor.sigma.square(), 0.0)
        square, values = _group_squares(part.residual, weight, pose)
        if pose is not None:
            left = (values - effective_parameters[k]).clamp(min=1.0)
            ratio = (square / left / view.noise[k].square()).clamp(min=1.0)
        if configuration is not None:
            shared, fewer = _group_squares(part.residual, weight, configuration)
            larger = ((shared / fewer) / (square / values)).clamp(min=1.0)
            ratio = torch.where(square > 0, ratio * larger, ratio)
        ratios[-1] = ratio
    return torch.stack(ratios)


def angle_variance_factor(
    sensors: Sequence[AbstractSensor],
    view: ContributionsAndNoise,
    prior_precision: Float64[Tensor, " active"],
    prior_gradient: Float64[Tensor, " active"],
) -> Float64[Tensor, " sensors"]:
    """Estimate the factor on the variance of measured angles, per sensor.

    Orientation errors that the geometry does not explain, such as the wobble of a wrist, depend on the pose. If rows
    are treated as independent, the angles seem to determine the geometry far better than they do, and pull the
    predicted positions away from the measured ones. Let x be the parameters estimated from lengths and prior alone,
    with the information A, and y the parameters estimated also from angles. Including the angles changes predicted
    lengths by `(x - y)^T Q (x - y)`, with the information Q of the lengths alone, while `tr(Q (cov x - cov y))` is
    expected. The factor, which is at least 1, makes both equal. It is the moment estimator of random-effects
    meta-analysis (DerSimonian and Laird 1986, Controlled Clinical Trials 7(3), 177-188), weighted by the cost of
    predicted lengths.

    Args:
        sensors: the sensors.
        view: normal equations and noise.
        prior_precision: prior precision of every free parameter.
        prior_gradient: contribution of the prior to the right-hand side of the normal equations.
    """
    angular = [sensor.unit == "rad" and not sensor.are_values_given for sensor in sensors]
    lengths = [sensor.unit != "rad" and not sensor.are_values_given for sensor in sensors]
    if not any(angular) or not any(lengths):
        return torch.ones_like(view.noise)
    variance = view.noise.square() * view.repeat_variance_factor
    normals = [part.normal / variance[k] for k, part in enumerate(view.contributions)]
    descents = [part.descent / variance[k] for k, part in enumerate(view.contributions)]
    zero = torch.zeros_like(normals[0]), torch.zeros_like(prior_gradient)
    by_lengths, by_angles = (
        (
            sum((one for one, angle in zip(normals, angular, strict=True) if angle is which), zero[0]),
            sum((one for one, angle in zip(descents, angular, strict=True) if angle is which), zero[1]),
        )
        for which in (False, True)
    )
    systems = (by_lengths[0], by_lengths[1] + prior_gradient, *by_angles, prior_precision)
    factor = _angle_disagreement(*(value.cpu().numpy() for value in systems))
    return prior_gradient.new_tensor([factor if angle else 1.0 for angle in angular])


def _angle_disagreement(
    Q: Float64[np.ndarray, "active active"],
    lengths: Float64[np.ndarray, " active"],
    R: Float64[np.ndarray, "active active"],
    angles: Float64[np.ndarray, " active"],
    held: Float64[np.ndarray, " active"],
) -> float:
    """Compute the factor from the normal equations of lengths and of angles, and the prior precision."""
    A = Q + np.diag(held)
    scale = (A + R).diagonal()
    scale = 1 / np.sqrt(np.where(scale > 0, scale, 1.0))
    root = np.linalg.cholesky(A * scale * scale[:, None] + UNDETERMINED * np.eye(len(scale)))
    white = np.linalg.inv(root) * scale
    # In these coordinates A is the identity and R is diagonal, so a factor on R needs no new factorisation.
    gain, axes = np.linalg.eigh(white @ R @ white.T)
    white = axes.T @ white
    Q, lengths, angles = white @ Q @ white.T, white @ lengths, white @ angles

    def excess(logarithm: float) -> float:
        """Return the observed minus the expected change of lengths for a factor `exp(logarithm)` on the variance."""
        # With A = I and R = diag(gain) / factor: cov x - cov y = diag(share), and moved = x - y.
        share = gain.clip(0.0) / (gain.clip(0.0) + math.exp(logarithm))
        moved = share * lengths - (1 - share) * angles * math.exp(-logarithm)
        return float(moved @ Q @ moved) - float(Q.diagonal() @ share)

    low, high = 0.0, math.log(_MAX_DISAGREEMENT)
    if excess(low) <= 0:
        return 1.0
    # Bisection keeps excess > 0 at low, and excess <= 0 at high unless that is the largest factor.
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return math.exp(high)


def _group_squares(
    residual: Float64[Tensor, "components rows"],
    weight: Float64[Tensor, " rows"],
    group: Int64[Tensor, " rows"] | None,
) -> tuple[Float64[Tensor, ""], Int64[Tensor, ""]]:
    """Return the sum of the squared weighted mean residuals of groups of rows, and its number of values."""
    components = residual.shape[0]
    if group is None:
        return (residual.square() * weight).sum(), (weight > 0).sum() * components
    groups = int(group.max()) + 1
    total = weight.new_zeros(groups).scatter_add(0, group, weight)
    summed = residual.new_zeros((components, groups)).index_add(1, group, residual * weight)
    squares = summed.square().sum(0) / total
    measured = total > 0
    return torch.where(measured, squares, 0.0).sum(), measured.sum() * components


def repeat_indices(q: Tensor, *names: Tensor) -> Tensor | None:
    """Return an index for every row that is equal for equal joint values (with payload) and names.

    Returns:
        The indices; None if all rows differ.
    """
    keys = torch.stack([groups_of_equal_joints(q), *names], 1)
    numbers: Tensor = torch.unique(keys, dim=0, return_inverse=True)[1]
    return None if int(numbers.max()) + 1 == len(q) else numbers
