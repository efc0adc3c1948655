"""Prior scales: ratios of the sizes of parameter errors to their prior standard deviations, by group of parameters."""

from enum import IntEnum

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import covariance_of

MAX_ITERATIONS, _CONVERGENCE_TOLERANCE = 8, 1e-3
"""Largest number of iterations of the prior scales at a point, and their relative change at convergence."""
_MIN_EFFECTIVE = 0.1
"""Effective number of parameters of a group below which its prior scale is not estimated."""
SMALLEST_PRIOR = 0.03
"""Smallest estimated prior scale."""


class PriorGroup(IntEnum):
    """Groups of parameters whose errors have a common prior scale, because they have the same cause.

    There are few groups, because a scale can only be estimated from several parameters; one scale per parameter
    (relevance vectors, Tipping 2001) fits the noise. Lengths that are nominally 0 have their own group, because
    calibrations of weak data were worse when they were joined with the others; it made no difference whether d and a,
    or alpha and beta, are separated.
    """

    JOINT_OFFSET = 0
    """Group of theta, the zeros of the joints."""
    LENGTH = 1
    """Group of d and a that are nominally nonzero, the lengths of links."""
    NO_LENGTH = 2
    """Group of d and a that are nominally 0 or below their tolerance, the distances between axes that should intersect
    or align."""
    BETWEEN_AXES = 3
    """Group of alpha and beta, the angles between axes."""


LENGTH_GROUPS = (PriorGroup.LENGTH, PriorGroup.NO_LENGTH)
"""Groups of lengths; the other groups are groups of angles."""


def prior_group_of(column: str, nonzero: bool) -> int:
    """Return the group of a parameter.

    Args:
        column: "theta", "d", "a", "alpha" or "beta"; other parameters have no prior, so their group is arbitrary.
        nonzero: whether the nominal value is larger than its tolerance.
    """
    if column in ("d", "a"):
        return PriorGroup.LENGTH if nonzero else PriorGroup.NO_LENGTH
    return PriorGroup.BETWEEN_AXES if column in ("alpha", "beta") else PriorGroup.JOINT_OFFSET


def effective_parameters(
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    prior_scale: Float64[Tensor, " groups"],
    covariance: Float64[Tensor, "active active"],
) -> Float64[Tensor, " groups"]:
    """Compute the effective number of parameters with a prior, per group.

    `γ = Σ (1 - posterior variance / prior variance)` (MacKay 1992, Neural Computation 4(3), eq. 4.5).

    Args:
        precision: 1 / variance of the stated prior; 0 for parameters without a prior.
        group: index of every parameter's group.
        prior_scale: scale of the prior per group.
        covariance: posterior covariance of the parameters.
    """
    variance = covariance.diagonal()
    lost = scaled_precision(precision, group, prior_scale) * variance
    return _group_totals(torch.where(precision > 0, torch.rsub(lost, 1), 0.0), group)


def scaled_precision(
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    prior_scale: Float64[Tensor, " groups"],
) -> Float64[Tensor, " active"]:
    """Compute the prior precision with the standard deviations multiplied by a scale per group."""
    return precision / prior_scale.square()[group]


def _group_totals(
    values: Float64[Tensor, " active"], group: Int64[Tensor, " active"]
) -> Float64[Tensor, " groups"]:
    """Sum values of the parameters per group."""
    return values.new_zeros(len(PriorGroup)).index_add(0, group, values)


def prior_scales(
    difference: Float64[Tensor, " active"],
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    current_scales: Float64[Tensor, " groups"],
    covariance: Float64[Tensor, "active active"],
    floor: float = 1.0,
) -> Float64[Tensor, " groups"]:
    """Estimate the prior scale of every group, the ratio of its errors to their stated standard deviations.

    This is MacKay's update (1992, Neural Computation 4(3), eq. 4.7) with the `effective_parameters` of every group.

    Args:
        difference: difference of the parameters from their nominal values [m or rad].
        precision: 1 / variance of the stated prior; 0 for parameters without a prior.
        group: index of every parameter's group.
        current_scales: current scale of the prior.
        covariance: posterior covariance of the parameters.
        floor: smallest scale; with 1, errors that are smaller than stated do not narrow the prior.
    """
    squares = _group_totals(difference.square() * precision, group)
    least = 1.0 if floor == 1.0 else _MIN_EFFECTIVE
    effective = effective_parameters(precision, group, current_scales, covariance)
    sized = (squares / effective).clamp(min=floor**2).sqrt()
    return torch.where(effective > least, sized, current_scales)


def converged_prior_scales(
    normal: Float64[Tensor, "active active"],
    right_hand_side: Float64[Tensor, " active"],
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    current_scales: Float64[Tensor, " groups"],
    floor: float,
) -> Float64[Tensor, " groups"]:
    """Iterate the prior scales and the step that results from them until convergence.

    Args:
        normal: normal matrix of the data, without the prior.
        right_hand_side: right-hand side of the normal equations relative to the nominal values.
        precision: see `prior_scales`.
        group: see `prior_scales`.
        current_scales: see `prior_scales`.
        floor: see `prior_scales`.
    """
    scale = current_scales
    for _ in range(MAX_ITERATIONS):
        # The solution of the linearised problem is `covariance @ pull`, so no new residuals are needed.
        held, current_scales = normal.clone(), scale
        held.diagonal().add_(scaled_precision(precision, group, current_scales))
        covariance = covariance_of(held)
        scale = prior_scales(
            covariance @ right_hand_side, precision, group, current_scales, covariance, floor
        )
        if has_converged(current_scales, scale, _CONVERGENCE_TOLERANCE):
            break
    return scale


def has_converged(previous: Tensor, current: Tensor, relative_tolerance: float) -> bool:
    """Return whether two estimates (of noise or prior scales) differ by less than a relative tolerance."""
    return bool(((current / previous - 1).abs() < relative_tolerance).all())
