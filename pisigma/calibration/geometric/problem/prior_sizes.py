"""How large the parameters' errors are in units of the prior's standard deviations, by groups of parameters."""

from enum import IntEnum

import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from pisigma.calibration.geometric.problem.least_squares import covariance_of

PRIOR_ROUNDS, PRIOR_SETTLED = 8, 1e-3
"""At one point the prior's sizes are estimated anew so often at most, or until they change by a smaller share."""
LEAST_EFFECTIVE = 0.1
"""The prior of a group of which the data determine less than so many parameters stays as it is."""
SMALLEST_PRIOR = 0.03
"""An estimated prior is not narrower than this share of the stated one."""


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


LENGTH_GROUPS = (PriorGroup.LENGTH, PriorGroup.NO_LENGTH)
"""Groups of lengths; the others are of angles."""


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
    prior_scale: Float64[Tensor, " groups"],
    covariance: Float64[Tensor, "active active"],
) -> Float64[Tensor, " groups"]:
    """How many parameters with a prior the data determine, per group: each counts by how much of it they do.

    `γ = Σ (1 - variance after / variance before)` of MacKay 1992, Neural Computation 4(3), eq. 4.5.

    Args:
        precision: 1 / variance as the prior states it, 0 where it says nothing.
        group: every parameter's group.
        prior_scale: the scale of the prior.
        covariance: of the parameters.
    """
    variance = covariance.diagonal()
    lost = scaled_precision(precision, group, prior_scale) * variance
    return _group_totals(torch.where(precision > 0, torch.rsub(lost, 1), 0.0), group)


def scaled_precision(
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    prior_scale: Float64[Tensor, " groups"],
) -> Float64[Tensor, " active"]:
    """1 / variance of parameters by the prior at a scale of its standard deviations per group."""
    return precision / prior_scale.square()[group]


def _group_totals(
    values: Float64[Tensor, " active"], group: Int64[Tensor, " active"]
) -> Float64[Tensor, " groups"]:
    """Sum of the parameters' values per group of the prior."""
    return values.new_zeros(len(PriorGroup)).index_add(0, group, values)


def prior_scales(
    off: Float64[Tensor, " active"],
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    before: Float64[Tensor, " groups"],
    covariance: Float64[Tensor, "active active"],
    floor: float = 1.0,
) -> Float64[Tensor, " groups"]:
    """How many times as large as stated the parameters' errors turn out, per group of parameters.

    MacKay's update (1992, Neural Computation 4(3), eq. 4.7) with the `effective_parameters` of every group.

    Args:
        off: distance of the parameters from their nominal values [m or rad].
        precision: 1 / variance as the prior states it, 0 where it says nothing.
        group: every parameter's group.
        before: the scale of the prior so far.
        covariance: of the parameters.
        floor: smallest answer; 1 where smaller errors than stated do not tighten the prior.
    """
    squares = _group_totals(off.square() * precision, group)
    least = 1.0 if floor == 1.0 else LEAST_EFFECTIVE
    effective = effective_parameters(precision, group, before, covariance)
    sized = (squares / effective).clamp(min=floor**2).sqrt()
    return torch.where(effective > least, sized, before)


def settled_scales(
    normal: Float64[Tensor, "active active"],
    pull: Float64[Tensor, " active"],
    precision: Float64[Tensor, " active"],
    group: Int64[Tensor, " active"],
    before: Float64[Tensor, " groups"],
    floor: float,
) -> Float64[Tensor, " groups"]:
    """Estimate the prior's sizes together with the step that they lead to, until they have settled.

    Args:
        normal: of the data, without the prior.
        pull: right-hand side of the normal equations, as seen from the nominal values.
        precision: see `prior_scales`, as for the next three.
        group: see there.
        before: see there.
        floor: see there.
    """
    scale = before
    for _ in range(PRIOR_ROUNDS):
        held, before = normal.clone(), scale
        held.diagonal().add_(scaled_precision(precision, group, before))
        covariance = covariance_of(held)
        scale = prior_scales(covariance @ pull, precision, group, before, covariance, floor)
        if alike(before, scale, PRIOR_SETTLED):
            break
    return scale


def alike(before: Tensor, after: Tensor, share: float) -> bool:
    """Whether two estimates of noise and of the prior's sizes differ by less than a share."""
    return bool(((after / before - 1).abs() < share).all())
