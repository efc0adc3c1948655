"""Distances between line segments, and from line segments to boxes, batched."""

import torch
from jaxtyping import Float64
from torch import Tensor

_MIN_SQUARED_LENGTH = 1e-18
"""Squared length below which a segment is treated as a point [m²]."""

Segments = Float64[Tensor, "*#batch 2 3"]
"""Both ends of line segments [m]."""


def segment_distance(first: Segments, second: Segments) -> Float64[Tensor, "*_batch"]:
    """Compute the distance between line segments [m].

    The nearest points of two segments are the nearest points of their lines, clamped to the segments one after the
    other (Ericson 2005, Real-Time Collision Detection, section 5.1.9). The batches broadcast.
    """
    p, u = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    r, v = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    w = p - r
    a, b, e = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    c, f = (u * w).sum(-1), (v * w).sum(-1)
    determinant = a * e - b * b
    # Parallel lines have the same distance everywhere, so s is arbitrary; clamped t and then s follow from it.
    parallel = determinant <= 1e-12 * a * e
    s = torch.where(parallel, 0.0, (b * f - c * e) / torch.where(parallel, 1.0, determinant)).clamp(0, 1)
    t = ((b * s + f) / e.clamp(min=_MIN_SQUARED_LENGTH)).clamp(0, 1)
    s = ((b * t - c) / a.clamp(min=_MIN_SQUARED_LENGTH)).clamp(0, 1)
    difference: Tensor = (w + s[..., None] * u - t[..., None] * v).norm(dim=-1)
    return difference


def box_distance(segments: Segments, half_size: Float64[Tensor, "*#batch 3"]) -> Float64[Tensor, "*_batch"]:
    """Compute the distance of line segments from boxes centred at the origin, 0 inside [m].

    The squared distance along a segment is convex, and its slope is linear between the planes of the box's faces, so
    the zero of the slope follows from the slopes at the two planes around it.

    Args:
        segments: segments in the frame of the box [m].
        half_size: half the lengths of the edges of the box [m].
    """
    start, along = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
    level = along == 0.0
    steps = torch.where(level, 1.0, along)
    planes = [torch.where(level, 0.0, (face - start) / steps).clamp(0, 1) for face in (-half_size, half_size)]
    first = torch.zeros_like(planes[0][..., :1])
    t = torch.cat([first, *planes, first + 1.0], -1)
    # half the slope of the squared distance at both ends and at every plane
    slope = torch.zeros_like(t)
    for s, u, half in zip(
        *(values[..., None].unbind(-2) for values in (start, along, half_size)), strict=True
    ):
        slope += u * _outside(s + t * u, half)
    falling = slope < 0
    low, high = torch.where(falling, t, 0.0).amax(-1), torch.where(falling, 1.0, t).amin(-1)
    before = torch.where(falling, slope, -torch.inf).amax(-1)
    behind = torch.where(falling, torch.inf, slope).amin(-1)
    # If the distance never rises, the end is nearest; if it never falls, the start is nearest.
    share = torch.where(behind.isinf(), 1.0, before / (before - torch.where(behind.isinf(), 0.0, behind)))
    share = torch.where(before.isinf(), 0.0, share)
    nearest = start + (low + share * (high - low))[..., None] * along
    distance: Tensor = _outside(nearest, half_size).norm(dim=-1)
    return distance


def _outside(point: Tensor, half: Tensor) -> Tensor:
    """Compute the distance of coordinates from a box centred at the origin [m]."""
    return point - torch.minimum(torch.maximum(point, -half), half)
