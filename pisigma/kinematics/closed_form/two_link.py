"""Two links in a plane, which all closed forms here share, and from what size on they take a number for 0."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pisigma.kinematics.components import Scalar
from pisigma.kinematics.tolerances import ROUNDINGS

ARM_BRANCHES = tuple(
    "/".join(choices)
    for choices in itertools.product(("front", "back"), ("elbow_up", "elbow_down"), ("no_flip", "flip"))
)
"""Names `shoulder/elbow/wrist` of the branches of arms with six joints."""

SINGULAR_TOLERANCE = 1e-6
"""A solution is SINGULAR where the sine of its elbow angle or of its wrist's bend, or the distance of the
wrist centre from axis 1 over the arm's reach, is smaller (in float32: than 1.2e-5)."""


def singular_tolerance(dtype: torch.dtype) -> float:
    """`SINGULAR_TOLERANCE`, or what rounding allows in a shorter float type."""
    return max(SINGULAR_TOLERANCE, 100 * torch.finfo(dtype).eps)


def rounding(dtype: torch.dtype) -> float:
    """Relative size below which a cosine beyond 1 or a length is taken for rounding (1.1e-13 in float64)."""
    return ROUNDINGS * torch.finfo(dtype).eps


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


def solve_two_link(
    x: Tensor, y: Tensor, a: float, b: float, elbow_sign: Scalar, first_when_free: float
) -> TwoLink:
    """Angles of two links that end in a point: appendix A's `C_2`, `S_2`, `K_1`, `K_2` for any lengths.

    Args:
        x: the point [m].
        y: the point [m].
        a: length of the first link [m], not 0; may be negative.
        b: length of the second link [m], positive.
        elbow_sign: +1 or -1, the sign of the sine of the elbow angle; broadcasts.
        first_when_free: the first angle [rad] where the point lies on its axis, so that any would do.

    Returns:
        The angles; where the point is out of reach they are those of the nearest arm and `reached` is False.
        A cosine beyond 1 by rounding counts as 1.
    """
    cosine = (x * x + y * y - (a * a + b * b)) / (2 * a * b)
    reached = cosine.abs() <= 1 + rounding(x.dtype)
    cosine = cosine.clamp(-1, 1)
    sine = elbow_sign * ((1 - cosine) * (1 + cosine)).sqrt()
    on_axis = torch.hypot(x, y) <= rounding(x.dtype) * (abs(a) + b)
    free = torch.atan2(b * sine, a + b * cosine)
    first = torch.where(on_axis, first_when_free, torch.atan2(y, x) - free)
    return TwoLink(first, torch.atan2(sine, cosine), reached, sine.abs() < singular_tolerance(x.dtype))
