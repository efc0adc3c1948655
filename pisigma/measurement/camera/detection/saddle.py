"""Corners of squares as saddles of gray values: a model of what the image shows around each is fitted to its pixels."""

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import erf

LARGEST = 16
"""[px] Half of the side of a window: lines that a lens bends are straight in it to some thousandths of a pixel."""
STEPS = 4
DAMPING = 1e-9
"""Added to the normal matrices, whose diagonals are scaled to 1: a window without contrast determines nothing."""
LOG_BLURS = np.log((0.2, 6.0))
"""Of what the fit may make of the blur [px]."""
FARTHEST = 0.5
"""[px] A fit that moves a corner by more has fitted something else."""
FIRST_BLUR = 1.0
"""[px] Standard deviation of the blur with which the fit begins."""


def fit_saddles(
    gray: Float64[np.ndarray, "height width"],
    pixels: Float64[np.ndarray, "corners 2"],
    axes: Float64[np.ndarray, "corners 2 2"],
    share: float,
) -> Float64[np.ndarray, "corners 2"]:
    """Fit corners where two black and two white squares meet, by least squares over the pixels around each.

    With `s_i` the distances of a pixel at x from the two lines through the corner at c, of the directions `θ_i`, its
    gray value is `(m + k erf(s_1 / √2 σ) erf(s_2 / √2 σ)) (1 + g · (x - c))`: edges that are blurred by σ, under light
    of the slope g. Nine unknowns of every corner (c, θ_1, θ_2, log σ, m, k, g) are found by Gauss-Newton steps. Where
    the noise of pixels is independent this is the most likely corner; the gradients of the same pixels leave twice the
    noise, and light that changes across the image moves them.

    Args:
        gray: image.
        pixels: corners, to half a pixel [px].
        axes: derivative of pixels by steps along rows and columns of squares, one in each column [px].
        share: of a square up to which nothing else is printed.

    Returns:
        The corners; those that the fit moves by more than `FARTHEST` stay.
    """
    x, weight = _windows(gray.shape, pixels, axes, share)
    values = gray[x[..., 1], x[..., 0]]
    x = x - pixels[:, None]
    state = np.zeros((len(pixels), 9))
    state[:, 2:4], state[:, 4] = np.arctan2(axes[:, 1], axes[:, 0]), np.log(FIRST_BLUR)
    saddle = weight * _saddle(x, state)[0]
    state[:, 5] = (weight * values).sum(1) / np.maximum(weight.sum(1), 1.0)
    state[:, 6] = (saddle * (values - state[:, 5, None])).sum(1) / np.maximum((saddle**2).sum(1), 1.0)
    for _ in range(STEPS):
        predicted, J = _predicted(x, state)
        weighted = (weight[..., None] * J).swapaxes(1, 2)
        normal, right = weighted @ J, weighted @ (values - predicted)[..., None]
        scale = np.sqrt(np.maximum(normal.diagonal(axis1=1, axis2=2), 1e-12))
        normal = normal / scale[:, :, None] / scale[:, None] + DAMPING * np.eye(9)
        state += np.linalg.solve(normal, right / scale[..., None])[..., 0] / scale
        state[:, 4] = np.clip(state[:, 4], *LOG_BLURS)
    moved = state[:, :2]
    kept = np.linalg.norm(moved, axis=1, keepdims=True) < FARTHEST
    return np.where(kept, pixels + moved, pixels)


def _windows(
    shape: tuple[int, ...],
    pixels: Float64[np.ndarray, "corners 2"],
    axes: Float64[np.ndarray, "corners 2 2"],
    share: float,
) -> tuple[Int64[np.ndarray, "corners window 2"], Float64[np.ndarray, "corners window"]]:
    """Return the pixels around every corner, and weights: 1 where nothing but its squares is shown, else 0."""
    side = np.arange(-LARGEST, LARGEST + 1)
    offsets = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    x = np.rint(pixels)[:, None].astype(int) + offsets
    in_squares = np.linalg.solve(axes, (x - pixels[:, None]).swapaxes(1, 2))
    size = np.array(shape[::-1])
    there = (np.abs(in_squares) < share).all(1) & (x >= 0).all(-1) & (x < size).all(-1)
    return np.clip(x, 0, size - 1), there.astype(float)


def _saddle(
    x: Float64[np.ndarray, "corners window 2"], state: Float64[np.ndarray, "corners _unknowns"]
) -> tuple[Float64[np.ndarray, "corners window"], Float64[np.ndarray, "corners window 5"]]:
    """Return the product of both blurred steps, and its derivatives by corner, angles and logarithm of the blur."""
    off = x - state[:, None, :2]
    blur = np.exp(state[:, 4, None])
    steps, slopes, alongs, normals = [], [], [], []
    for line in (2, 3):
        cos, sin = np.cos(state[:, line, None]), np.sin(state[:, line, None])
        distance = (cos * off[..., 1] - sin * off[..., 0]) / blur
        steps.append(erf(distance / np.sqrt(2)))
        slopes.append(np.sqrt(2 / np.pi) * np.exp(-(distance**2) / 2))
        alongs.append((cos * off[..., 0] + sin * off[..., 1]) / blur)
        normals.append((sin / blur, -cos / blur, distance))
    by = np.empty((*x.shape[:2], 5))
    first, second = slopes[0] * steps[1], steps[0] * slopes[1]
    for axis in (0, 1):
        by[..., axis] = first * normals[0][axis] + second * normals[1][axis]
    by[..., 2], by[..., 3] = -first * alongs[0], -second * alongs[1]
    by[..., 4] = -first * normals[0][2] - second * normals[1][2]
    return steps[0] * steps[1], by


def _predicted(
    x: Float64[np.ndarray, "corners window 2"], state: Float64[np.ndarray, "corners 9"]
) -> tuple[Float64[np.ndarray, "corners window"], Float64[np.ndarray, "corners window 9"]]:
    """Return gray values, and their derivatives by all unknowns."""
    saddle, by = _saddle(x, state)
    light = 1 + (state[:, None, 7:] * x).sum(-1)
    printed = state[:, 5, None] + state[:, 6, None] * saddle
    by_level = np.stack([light, light * saddle], -1)
    by = by * (state[:, 6, None] * light)[..., None]
    return printed * light, np.concatenate([by, by_level, x * printed[..., None]], -1)
