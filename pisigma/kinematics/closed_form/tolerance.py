"""From what size on a closed form takes a number for 0."""

import torch

SINGULAR_TOLERANCE = 1e-6
"""A solution is SINGULAR where the sine of its elbow angle or of its wrist's bend, or the distance of the
wrist centre from axis 1 over the arm's reach, is smaller (in float32: than 1.2e-5)."""


def singular_tolerance(dtype: torch.dtype) -> float:
    """`SINGULAR_TOLERANCE`, or what rounding allows in a shorter float type."""
    return max(SINGULAR_TOLERANCE, 100 * torch.finfo(dtype).eps)


def rounding(dtype: torch.dtype) -> float:
    """Relative size below which a cosine beyond 1 or a length is taken for rounding (1.1e-13 in float64)."""
    return 500 * torch.finfo(dtype).eps
