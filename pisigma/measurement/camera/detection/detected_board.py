"""Refine corners of a board in an image to sub-pixel accuracy, as saddles of gray values, and measure the blur."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import map_coordinates
from scipy.special import erf

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import MIN_CORNERS

Image = UInt8[np.ndarray, "height width"]
"""Gray values of an image; the centre of the first pixel is at u = v = 0."""
_ALONG = np.linspace(0.2, 0.8, 9)
"""Positions along an edge, relative to its length, at which it is sampled, away from other edges."""
_ACROSS = np.linspace(-1.0, 1.0, 41)
"""Positions of the samples across an edge, relative to half the sampled width."""
_FOLLOWED = 0.7
"""Half the sampled width relative to the clearance of an edge; it is < 1 because neighbouring edges are also
blurred."""
_ENDS = 0.7
"""Relative position across an edge beyond which the samples are fully black or white."""
_SMOOTHING = 1.5
"""Standard deviation [px] of the smoothing before gradients are computed, which is less in small windows; it is the
best value on rendered images."""
_WINDOW = 0.8
"""Half the side of the window around a corner, relative to the clearance."""
_MIN_SQUARE = 16.0
"""Smallest area of a square in the image whose corners are refined [px²]."""
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)
_MAX_HALF_WINDOW = 16
"""Largest half side of a window [px], within which lines distorted by a lens are straight to some thousandths of a
pixel."""
_ITERATIONS = 4
_DAMPING = 1e-9
"""Damping of the normal matrices, whose diagonals are scaled to 1, for windows without contrast."""
_LOG_BLURS = np.log((0.2, 6.0))
"""Logarithms of the smallest and largest blur [px] that a fit may have."""
_MAX_SHIFT = 0.5
"""Shift of a corner [px] above which a fit is discarded, because it has fitted another structure."""
_INITIAL_BLUR = 1.0
"""Initial standard deviation of the blur in a fit [px]."""


@dataclass(frozen=True, eq=False)
class DetectedBoard:
    """The corners of a board in an image.

    Attributes:
        corner_numbers: numbers of the corners, see `Board`.
        pixels: u and v of every corner [px].
    """

    corner_numbers: Int64[np.ndarray, " corners"]
    pixels: Float64[np.ndarray, "corners 2"]


@dataclass(frozen=True)
class NoBoard:
    """An image without usable corners.

    Attributes:
        reason: the reason as a clause, such as "no board was found in it".
        found_size: numbers of rows and columns of the corners that were found; None if no corners were found.
        is_mirrored: whether the image is mirrored.
    """

    reason: str
    found_size: tuple[int, int] | None = None
    is_mirrored: bool = False


def edge_pixels(detected: DetectedBoard, board: Board) -> Float64[np.ndarray, "edges 2 2"]:
    """Return the pixels of both ends of all edges of the board between detected corners [px]."""
    pixels = np.full((len(board.corners), 2), np.nan)
    pixels[detected.corner_numbers] = detected.pixels
    ends = pixels[board.edges]
    shown: np.ndarray = ends[np.isfinite(ends).all((1, 2))]
    return shown


def refine_corners(image: Image, detected: DetectedBoard, board: Board) -> DetectedBoard:
    """Return corners of squares refined to sub-pixel accuracy.

    Corners are first moved to the point to which the gradients around them are perpendicular (Förstner & Gülch 1987).
    The window around each is as large as possible without other edges in it; corners whose window extends beyond the
    image are left out. The gray values are then fitted, see `fit_saddles`.

    Args:
        image: the image.
        detected: approximate corners.
        board: the board.
    """
    ends = edge_pixels(detected, board)
    shortest = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min(initial=np.inf)
    half = max(round(_WINDOW * board.relative_edge_clearance * shortest), 2) if len(ends) else 2
    start = np.ascontiguousarray(detected.pixels, dtype=np.float32).reshape(-1, 1, 2)
    # without smoothing, gradients of a sharp image are biased by some hundredths of a pixel
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), min(_SMOOTHING, half / 4))
    moved = cv2.cornerSubPix(smooth, start, (half, half), (-1, -1), _STOP)
    pixels = np.asarray(moved, dtype=np.float64).reshape(-1, 2)
    inside = (np.abs(pixels - np.array(image.shape[::-1]) / 2) < np.array(image.shape[::-1]) / 2 - half).all(
        1
    )
    corners, pixels = detected.corner_numbers[inside], pixels[inside]
    axes = _axes_of_squares(board.corners[corners, :2] / board.square, pixels)
    if axes is not None:
        pixels = fit_saddles(image.astype(np.float64), pixels, axes, _WINDOW * board.relative_edge_clearance)
    return DetectedBoard(corners, pixels)


def _axes_of_squares(
    grid: Float64[np.ndarray, "corners 2"], pixels: Float64[np.ndarray, "corners 2"]
) -> Float64[np.ndarray, "corners 2 2"] | None:
    """Return the change of pixels per step along rows and columns of squares; None if there is no homography."""
    H = cv2.findHomography(grid, pixels)[0] if len(grid) > MIN_CORNERS and np.ptp(grid, 0).all() else None
    if H is None:
        return None
    projected = grid @ H[:, :2].T + H[:, 2]
    axes = (H[:2, :2] - (projected[:, :2] / projected[:, 2:])[..., None] * H[2, :2]) / projected[:, 2:, None]
    return axes if (np.abs(np.linalg.det(axes)) > _MIN_SQUARE).all() else None


@dataclass(frozen=True, eq=False)
class EdgeProfiles:
    """Profiles of the gray values across the edges of a board.

    Attributes:
        points: crossing points on every edge [px].
        half_profile_vectors: normal vectors of the edges, with half the sampled width as length [px].
        gray_values: gray values along the crossings, from 0 at the start to 1 at the end; NaN without contrast.
    """

    points: Float64[np.ndarray, "edges crossings 2"]
    half_profile_vectors: Float64[np.ndarray, "edges 2"]
    gray_values: Float64[np.ndarray, "edges crossings samples"]

    @staticmethod
    def from_image(
        image: Image, ends: Float64[np.ndarray, "edges 2 2"], relative_edge_clearance: float
    ) -> "EdgeProfiles":
        """Sample an image across edges.

        Args:
            image: the image.
            ends: pixels of both ends of every edge [px].
            relative_edge_clearance: width of the uniform areas on both sides of an edge relative to its length, see
                `Board.clearance`.
        """
        along = ends[:, 1] - ends[:, 0]
        across = _FOLLOWED * relative_edge_clearance * np.stack([-along[:, 1], along[:, 0]], -1)
        at = ends[:, :1] + _ALONG[:, None] * along[:, None]
        sampled = at[:, :, None] + _ACROSS[:, None] * across[:, None, None]
        gray = map_coordinates(
            image.astype(np.float64), [sampled[..., 1], sampled[..., 0]], order=1, mode="nearest"
        )
        first, last = (
            gray[..., side].mean((1, 2))[:, None, None] for side in (_ACROSS < -_ENDS, _ACROSS > _ENDS)
        )
        contrast = np.where(np.abs(last - first) < 1.0, np.nan, last - first)
        return EdgeProfiles(at, across, (gray - first) / contrast)

    @property
    def blur(self) -> float:
        """Standard deviation of the blur [px]; NaN without edges.

        The area between a step from 0 to 1 and the step blurred with the standard deviation σ is `σ sqrt(2/π)`. Motion
        blurs only the edges across it, so the third quartile of all edges is returned.
        """
        missing = np.where(_ACROSS < 0, self.gray_values, 1 - self.gray_values).mean((1, 2))
        blur = 2 * np.linalg.norm(self.half_profile_vectors, axis=1) * missing / np.sqrt(2 / np.pi)
        return float(np.nanquantile(blur, 0.75)) if np.isfinite(blur).any() else np.nan

    @property
    def edge_positions(self) -> Float64[np.ndarray, "edges crossings 2"]:
        """Position of the edge on every crossing [px], with equal blurred areas on both sides.

        Edges without contrast keep their position.
        """
        offset = np.nan_to_num(1 - 2 * self.gray_values.mean(2))
        points: np.ndarray = self.points + offset[..., None] * self.half_profile_vectors[:, None]
        return points


def fit_saddles(
    gray: Float64[np.ndarray, "height width"],
    pixels: Float64[np.ndarray, "corners 2"],
    pixels_per_square: Float64[np.ndarray, "corners 2 2"],
    relative_edge_clearance: float,
) -> Float64[np.ndarray, "corners 2"]:
    """Fit corners between two black and two white squares by least squares over the surrounding pixels.

    With `s_i` the distances of a pixel at x from the two lines of directions `θ_i` through the corner at c, its gray
    value is `(m + k erf(s_1 / √2 σ) erf(s_2 / √2 σ)) (1 + g · (x - c))`: edges blurred by σ, under light of gradient g.
    The nine unknowns of every corner (c, θ_1, θ_2, log σ, m, k, g) are found by Gauss-Newton steps. For independent
    noise of the pixels, this is the maximum-likelihood estimate; corners computed from gradients of the same pixels
    have twice the noise and are biased by gradients of the light.

    Args:
        gray: gray values of the image.
        pixels: corners, accurate to half a pixel [px].
        pixels_per_square: derivative of pixels with respect to steps along rows and columns of squares, one in each
            column [px].
        relative_edge_clearance: distance from a corner within which no other edge is printed, relative to a square.

    Returns:
        The corners; those that a fit would move by more than `_MAX_SHIFT` are not changed.
    """
    x, weight = _windows(gray.shape, pixels, pixels_per_square, relative_edge_clearance)
    values = gray[x[..., 1], x[..., 0]]
    x = x - pixels[:, None]
    state = np.zeros((len(pixels), 9))
    state[:, 2:4], state[:, 4] = (
        np.arctan2(pixels_per_square[:, 1], pixels_per_square[:, 0]),
        np.log(_INITIAL_BLUR),
    )
    saddle = weight * _saddle(x, state)[0]
    state[:, 5] = (weight * values).sum(1) / np.maximum(weight.sum(1), 1.0)
    state[:, 6] = (saddle * (values - state[:, 5, None])).sum(1) / np.maximum((saddle**2).sum(1), 1.0)
    for _ in range(_ITERATIONS):
        predicted, J = _predicted(x, state)
        weighted = (weight[..., None] * J).swapaxes(1, 2)
        normal, right = weighted @ J, weighted @ (values - predicted)[..., None]
        scale = np.sqrt(np.maximum(normal.diagonal(axis1=1, axis2=2), 1e-12))
        normal = normal / scale[:, :, None] / scale[:, None] + _DAMPING * np.eye(9)
        state += np.linalg.solve(normal, right / scale[..., None])[..., 0] / scale
        state[:, 4] = np.clip(state[:, 4], *_LOG_BLURS)
    moved = state[:, :2]
    kept = np.linalg.norm(moved, axis=1, keepdims=True) < _MAX_SHIFT
    return np.where(kept, pixels + moved, pixels)


def _windows(
    shape: tuple[int, ...],
    pixels: Float64[np.ndarray, "corners 2"],
    axes: Float64[np.ndarray, "corners 2 2"],
    share: float,
) -> tuple[Int64[np.ndarray, "corners window 2"], Float64[np.ndarray, "corners window"]]:
    """Return the pixels around every corner, and their weights: 1 within the squares of the corner, otherwise 0."""
    side = np.arange(-_MAX_HALF_WINDOW, _MAX_HALF_WINDOW + 1)
    offsets = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    x = np.rint(pixels)[:, None].astype(int) + offsets
    in_squares = np.linalg.solve(axes, (x - pixels[:, None]).swapaxes(1, 2))
    size = np.array(shape[::-1])
    there = (np.abs(in_squares) < share).all(1) & (x >= 0).all(-1) & (x < size).all(-1)
    return np.clip(x, 0, size - 1), there.astype(float)


def _saddle(
    x: Float64[np.ndarray, "corners window 2"], state: Float64[np.ndarray, "corners _unknowns"]
) -> tuple[Float64[np.ndarray, "corners window"], Float64[np.ndarray, "corners window 5"]]:
    """Return the product of both blurred steps, and its derivatives with respect to corner, angles and log blur."""
    off = x - state[:, None, :2]
    blur = np.exp(state[:, 4, None])
    steps, slopes, alongs, normals = [], [], [], []
    for line in (2, 3):
        cos, sin = np.cos(state[:, line, None]), np.sin(state[:, line, None])
        distance = (cos * off[..., 1] - sin * off[..., 0]) / blur
        # An edge between -1 and 1 blurred by a normal distribution is erf(d / sqrt(2)), at a distance of d blurs.
        steps.append(erf(distance / np.sqrt(2)))
        slopes.append(np.sqrt(2 / np.pi) * np.exp(-(distance**2) / 2))
        alongs.append((cos * off[..., 0] + sin * off[..., 1]) / blur)
        # Derivatives of d: (sin, -cos) / blur with respect to the corner, -along to the angle, -d to the logarithm of
        # the blur.
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
    """Return predicted gray values, and their derivatives with respect to all unknowns."""
    saddle, by = _saddle(x, state)
    light = 1 + (state[:, None, 7:] * x).sum(-1)
    printed = state[:, 5, None] + state[:, 6, None] * saddle
    by_level = np.stack([light, light * saddle], -1)
    by = by * (state[:, 6, None] * light)[..., None]
    return printed * light, np.concatenate([by, by_level, x * printed[..., None]], -1)
