"""Solutions for joint 1 and for two links in a plane, shared by closed forms, with their rounding tolerances."""

import itertools
import math
from dataclasses import dataclass
from typing import Any, no_type_check

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.robot.kinematics.components import Scalar
from pisigma.robot.kinematics.tolerances import ROUNDING_UNITS

ARM_BRANCHES = tuple(
    "/".join(choices)
    for choices in itertools.product(("front", "back"), ("elbow_up", "elbow_down"), ("no_flip", "flip"))
)
"""Branch names `shoulder/elbow/wrist` of arms with six joints."""

SINGULAR_TOLERANCE = 1e-6
"""A solution is SINGULAR if the sine of its elbow angle, the sine of its wrist angle, or the distance of the wrist
centre from axis 1 divided by the arm's reach is smaller than this (in float32: 1.2e-5)."""


def singular_tolerance(dtype: torch.dtype) -> float:
    """Return `SINGULAR_TOLERANCE`, or a larger value for a shorter float type."""
    return max(SINGULAR_TOLERANCE, 100 * torch.finfo(dtype).eps)


def rounding_tolerance(dtype: torch.dtype) -> float:
    """Return the relative size below which a cosine beyond 1 or a length is a rounding error (1.1e-13 in float64)."""
    return ROUNDING_UNITS * torch.finfo(dtype).eps


@dataclass(frozen=True, eq=False)
class TwoLink:
    """Solutions of `(x, y) = R(first) · ((a, 0) + R(elbow) · (b, 0))`.

    Attributes:
        first: angle of the first link [rad].
        elbow: angle from the first link to the second [rad].
        reached: whether the point is within reach.
        singular: whether the arm is stretched or folded.
    """

    first: Float[Tensor, "*batch"]
    elbow: Float[Tensor, "*batch"]
    reached: Bool[Tensor, "..."]
    singular: Bool[Tensor, "..."]


def solve_first_joint(
    x: Tensor,
    y: Tensor,
    side: float,
    scale: float,
    shoulder: Scalar,
    azimuth_when_free: float,
    min_squared_distance_share: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Solve joint 1, which brings a point to a distance `side` from the plane of the arm: `c_1 y - s_1 x = side`.

    Args:
        x: x of the point [m].
        y: y of the point [m].
        side: distance of the point to the left of the arm's plane [m].
        scale: length of the arm [m], to which rounding errors are relative.
        shoulder: +1 for a point ahead of axis 1, -1 for one behind it; broadcasts.
        azimuth_when_free: azimuth [rad] to use for a point on axis 1, for which it is arbitrary.
        min_squared_distance_share: smallest square of the distance ahead of axis 1, as a share of the squared scale.

    Returns:
        The angle [rad], the distance of the point ahead of axis 1 in the plane [m], and whether a solution exists.
    """
    square = x * x + y * y - side * side
    reached = square >= -rounding_tolerance(x.dtype) * scale * scale
    ahead = shoulder * square.clamp(min=min_squared_distance_share * scale * scale).sqrt()
    on_axis = torch.hypot(x, y) <= rounding_tolerance(x.dtype) * scale
    azimuth = torch.where(on_axis, azimuth_when_free, torch.atan2(y, x))
    angle = azimuth - torch.atan2(torch.full_like(ahead, side), ahead)
    # On axis 1 `ahead` is 0 or -0, and atan2 of two rounding errors is arbitrary; the back branch is half a turn
    # from the azimuth.
    back = azimuth - math.copysign(math.pi, side)
    return torch.where(on_axis & ahead.signbit(), back, angle), ahead, reached


def solve_two_link(
    x: Tensor, y: Tensor, a: float, b: float, elbow_sign: Scalar, first_when_free: float, cosine_margin: float
) -> TwoLink:
    """Solve the angles of two links that end at a point: appendix A's `C_2`, `S_2`, `K_1`, `K_2` for any lengths.

    Args:
        x: x of the point [m].
        y: y of the point [m].
        a: length of the first link [m], not 0; may be negative.
        b: length of the second link [m], positive.
        elbow_sign: +1 or -1, the sign of the sine of the elbow angle; broadcasts.
        first_when_free: first angle [rad] to use for a point on the first axis, for which it is arbitrary.
        cosine_margin: distance that the cosine of the elbow angle keeps from 1.

    Returns:
        The angles. For a point out of reach the arm is as near to it as possible and `reached` is False. A cosine
        that exceeds 1 by rounding is treated as 1.
    """
    cosine = (x * x + y * y - (a * a + b * b)) / (2 * a * b)
    reached = cosine.abs() <= 1 + rounding_tolerance(x.dtype)
    cosine = cosine.clamp(cosine_margin - 1, 1 - cosine_margin)
    # (1 - c)(1 + c) is accurate near a stretched arm, where 1 - c² suffers from cancellation.
    sine = elbow_sign * ((1 - cosine) * (1 + cosine)).sqrt()
    on_axis = torch.hypot(x, y) <= rounding_tolerance(x.dtype) * (abs(a) + b)
    # Angle from the first link to the line to the point.
    free = torch.atan2(b * sine, a + b * cosine)
    first = torch.where(on_axis, first_when_free, torch.atan2(y, x) - free)
    return TwoLink(first, torch.atan2(sine, cosine), reached, sine.abs() < singular_tolerance(x.dtype))


@no_type_check
def two_link(
    x: float, y: float, a: float, b: float, elbow_sign: float, free: float, rounding: float, margin: float
) -> tuple[float, float, bool]:
    """Return the angles of `solve_two_link` [rad] on plain numbers, and whether the point is within reach."""
    cosine = (x * x + y * y - (a * a + b * b)) / (2 * a * b)
    reached = abs(cosine) <= 1 + rounding
    cosine = min(max(cosine, margin - 1), 1 - margin)
    # (1 - c)(1 + c) is accurate near a stretched arm, where 1 - c² suffers from cancellation.
    sine = elbow_sign * math.sqrt((1 - cosine) * (1 + cosine))
    first = free
    if math.sqrt(x * x + y * y) > rounding * (abs(a) + b):
        # The second term is the angle from the first link to the line to the point.
        first = math.atan2(y, x) - math.atan2(b * sine, a + b * cosine)
    return first, math.atan2(sine, cosine), reached


@no_type_check
def first_joint(
    P: Any, side: float, scale: float, zero: float, rounding: float, margin: float
) -> tuple[float, float, bool, bool]:
    """Locate a point relative to axis 1 of an arm, at a distance `side` [m] from the plane of the arm.

    Returns:
        The distance [m] ahead of axis 1, the azimuth [rad], whether a solution exists, and whether the point is on the
        axis, so joint 1 is arbitrary.
    """
    x, y = P[0, 3], P[1, 3]
    square = x * x + y * y - side * side
    on_axis = math.hypot(x, y) <= rounding * scale
    azimuth = zero if on_axis else math.atan2(y, x)
    ahead = math.sqrt(max(square, margin * scale * scale))
    return ahead, azimuth, square >= -rounding * scale * scale, on_axis
