"""Distances of line segments from each other and from boxes, batched."""

import torch
from jaxtyping import Float64
from torch import Tensor

SMALLEST = 1e-18
"""[m²] Segments whose squared length is smaller are points."""
HALVINGS = 40
"""Of a segment, to find where it is nearest to a box: 1e-12 of its length."""

Segments = Float64[Tensor, "*#batch 2 3"]
"""Both ends of line segments [m]."""


def segment_distance(first: Segments, second: Segments) -> Float64[Tensor, "*_batch"]:
    """Distance of line segments [m].

    The nearest points of two segments are those of their lines, moved into the segments one after the other
    (Ericson 2005, Real-Time Collision Detection, section 5.1.9). The batches broadcast.
    """
    p, u = first[..., 0, :], first[..., 1, :] - first[..., 0, :]
    r, v = second[..., 0, :], second[..., 1, :] - second[..., 0, :]
    w = p - r
    a, b, e = (u * u).sum(-1), (u * v).sum(-1), (v * v).sum(-1)
    c, f = (u * w).sum(-1), (v * w).sum(-1)
    determinant = a * e - b * b
    parallel = determinant <= 1e-12 * a * e
    s = torch.where(parallel, 0.0, (b * f - c * e) / torch.where(parallel, 1.0, determinant)).clamp(0, 1)
    t = ((b * s + f) / e.clamp(min=SMALLEST)).clamp(0, 1)
    s = ((b * t - c) / a.clamp(min=SMALLEST)).clamp(0, 1)
    difference: Tensor = (w + s[..., None] * u - t[..., None] * v).norm(dim=-1)
    return difference


def box_distance(segments: Segments, half_size: Float64[Tensor, "*#batch 3"]) -> Float64[Tensor, "*_batch"]:
    """Distance of line segments from boxes about the origin, 0 inside [m].

    The squared distance along a segment is convex with a continuous slope, whose sign is halved for.

    Args:
        segments: in the frame of the box.
        half_size: of the box along its axes [m].
    """
    start, along = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]
    low = (start + half_size)[..., 0] * 0.0
    width = torch.ones_like(low)

    def outside(t: Tensor) -> Tensor:
        point = start + t[..., None] * along
        return point - torch.minimum(torch.maximum(point, -half_size), half_size)

    for _ in range(HALVINGS):
        width = width / 2
        falling = (outside(low + width) * along).sum(-1) < 0
        low = torch.where(falling, low + width, low)
    ends = torch.stack([outside(t) for t in (low, low + width)])
    nearest: Tensor = ends.norm(dim=-1).min(0).values
    return nearest
