"""Corners of a board in an image: refined to sub-pixel, and how blurred the edges between them are."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import map_coordinates

Image = UInt8[np.ndarray, "height width"]
"""Grey values; the centre of the first pixel is at u = v = 0."""
ALONG = np.array([0.3, 0.4, 0.5, 0.6, 0.7])
"""Where edges are crossed, as shares of their lengths: away from other edges."""
ACROSS = np.linspace(-1.0, 1.0, 41)
"""Where they are sampled on both sides, as shares of `REACH`."""
REACH = 0.3
"""Share of the length of an edge, to both of its sides."""
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)


@dataclass(frozen=True, eq=False)
class DetectedBoard:
    """The corners of a board in an image.

    Attributes:
        corners: their numbers, see `Board`.
        pixels: u and v of each [px].
    """

    corners: Int64[np.ndarray, " corners"]
    pixels: Float64[np.ndarray, "corners 2"]


@dataclass(frozen=True)
class NoBoard:
    """An image without corners that can be used.

    Attributes:
        reason: clause that says why, such as "no board is found in it".
    """

    reason: str


def refined(image: Image, pixels: np.ndarray, radius: float) -> Float64[np.ndarray, "corners 2"]:
    """Move corners to where the gradients around them point past (Förstner & Gülch 1987).

    Args:
        image: that shows them.
        pixels: about where they are [px].
        radius: half of the side of the square around each that is looked at [px].
    """
    half = max(round(radius), 2)
    start = np.ascontiguousarray(pixels, dtype=np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start, (half, half), (-1, -1), _STOP)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)


def edge_blur(image: Image, ends: Float64[np.ndarray, "edges 2 2"]) -> float:
    """Standard deviation of the blur across the edges of a board [px].

    Of a step from a to b that is blurred with the standard deviation σ, the areas between profile and step sum up to
    `(b - a) σ sqrt(2/π)`. A motion blurs edges across it only, so that the third quartile of all edges is given.

    Args:
        image: that shows the board.
        ends: pixels of both ends of every edge [px].
    """
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    normal = np.stack([-along[:, 1], along[:, 0]], -1) / length[:, None]
    reach = REACH * length
    at = ends[:, :1] + ALONG[:, None] * along[:, None]
    at = at[:, :, None] + (reach[:, None] * ACROSS)[:, None, :, None] * normal[:, None, None]
    profile = map_coordinates(
        image.astype(np.float64), [at[..., 1], at[..., 0]], order=1, mode="nearest"
    ).mean(1)
    first, last = (profile[:, side].mean(1) for side in (ACROSS < -0.7, ACROSS > 0.7))
    missing = np.where(ACROSS < 0, profile - first[:, None], last[:, None] - profile)
    contrast = last - first
    contrast[np.abs(contrast) < 1.0] = np.nan
    area = missing.mean(1) * 2 * reach / contrast
    return float(np.nanquantile(area, 0.75) / np.sqrt(2 / np.pi))
