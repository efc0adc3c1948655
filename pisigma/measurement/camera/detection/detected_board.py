"""Corners of a board in an image: refined to sub-pixel as saddles of gray values, and how blurred the edges are."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import map_coordinates
from scipy.special import erf

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import FEWEST_CORNERS

Image = UInt8[np.ndarray, "height width"]
"""Gray values; the centre of the first pixel is at u = v = 0."""
ALONG = np.linspace(0.2, 0.8, 9)
"""Where edges are crossed, as shares of their lengths: away from other edges."""
ACROSS = np.linspace(-1.0, 1.0, 41)
"""Where they are sampled on both sides, as shares of how far they are followed."""
FOLLOWED = 0.7
"""Share of the clearance of an edge in which it is followed: what is printed beyond is blurred, too."""
ENDS = 0.7
"""From here on, an edge is as black or as white as it gets."""
SMOOTHING = 1.5
"""[px] Standard deviation of the blur before gradients are taken, less in small windows; best on rendered images."""
WINDOW = 0.8
"""Half of the side of the window around a corner, as share of the clearance."""
SMALLEST_SQUARE = 16.0
"""[px²] Squares that appear smaller hold no window."""
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-4)
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


def shown_edges(detected: DetectedBoard, board: Board) -> Float64[np.ndarray, "edges 2 2"]:
    """Pixels of both ends of the edges of a board between corners that were detected [px]."""
    pixels = np.full((len(board.corners), 2), np.nan)
    pixels[detected.corners] = detected.pixels
    ends = pixels[board.edges]
    shown: np.ndarray = ends[np.isfinite(ends).all((1, 2))]
    return shown


def refined(image: Image, detected: DetectedBoard, board: Board) -> DetectedBoard:
    """Move the corners of squares to where the gradients around them point past (Förstner & Gülch 1987), and fit them.

    The window around each is as large as it can be without other edges in it; corners whose window leaves the image are
    left out. From there the gray values are fitted, see `fit_saddles`.

    Args:
        image: that shows them.
        detected: about where they are.
        board: whose corners they are.
    """
    ends = shown_edges(detected, board)
    shortest = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min(initial=np.inf)
    half = max(round(WINDOW * board.clearance * shortest), 2) if len(ends) else 2
    start = np.ascontiguousarray(detected.pixels, dtype=np.float32).reshape(-1, 1, 2)
    # gradients of pixels that are sharp against their size point past the corner by some hundredths of a pixel
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), min(SMOOTHING, half / 4))
    moved = cv2.cornerSubPix(smooth, start, (half, half), (-1, -1), _STOP)
    pixels = np.asarray(moved, dtype=np.float64).reshape(-1, 2)
    inside = (np.abs(pixels - np.array(image.shape[::-1]) / 2) < np.array(image.shape[::-1]) / 2 - half).all(
        1
    )
    corners, pixels = detected.corners[inside], pixels[inside]
    axes = _axes_of_squares(board.corners[corners, :2] / board.square, pixels)
    if axes is not None:
        pixels = fit_saddles(image.astype(np.float64), pixels, axes, WINDOW * board.clearance)
    return DetectedBoard(corners, pixels)


def _axes_of_squares(
    grid: Float64[np.ndarray, "corners 2"], pixels: Float64[np.ndarray, "corners 2"]
) -> Float64[np.ndarray, "corners 2 2"] | None:
    """Derivatives of pixels by steps along rows and columns of squares, by their homography; None without one."""
    H = cv2.findHomography(grid, pixels)[0] if len(grid) > FEWEST_CORNERS and np.ptp(grid, 0).all() else None
    if H is None:
        return None
    projected = grid @ H[:, :2].T + H[:, 2]
    axes = (H[:2, :2] - (projected[:, :2] / projected[:, 2:])[..., None] * H[2, :2]) / projected[:, 2:, None]
    return axes if (np.abs(np.linalg.det(axes)) > SMALLEST_SQUARE).all() else None


@dataclass(frozen=True, eq=False)
class EdgeProfiles:
    """How black turns to white across the edges of a board.

    Attributes:
        at: where every edge is crossed [px].
        across: normals of the edges as long as they are followed to each side [px].
        profile: gray level along the crossings, from 0 at their begin to 1 at their end; NaN without contrast.
    """

    at: Float64[np.ndarray, "edges crossings 2"]
    across: Float64[np.ndarray, "edges 2"]
    profile: Float64[np.ndarray, "edges crossings samples"]

    @staticmethod
    def of(image: Image, ends: Float64[np.ndarray, "edges 2 2"], clearance: float) -> "EdgeProfiles":
        """Sample an image across edges.

        Args:
            image: that shows the board.
            ends: pixels of both ends of every edge [px].
            clearance: share of the length of an edge to whose sides nothing else is printed, see `Board.clearance`.
        """
        along = ends[:, 1] - ends[:, 0]
        across = FOLLOWED * clearance * np.stack([-along[:, 1], along[:, 0]], -1)
        at = ends[:, :1] + ALONG[:, None] * along[:, None]
        sampled = at[:, :, None] + ACROSS[:, None] * across[:, None, None]
        gray = map_coordinates(
            image.astype(np.float64), [sampled[..., 1], sampled[..., 0]], order=1, mode="nearest"
        )
        first, last = (
            gray[..., side].mean((1, 2))[:, None, None] for side in (ACROSS < -ENDS, ACROSS > ENDS)
        )
        contrast = np.where(np.abs(last - first) < 1.0, np.nan, last - first)
        return EdgeProfiles(at, across, (gray - first) / contrast)

    @property
    def blur(self) -> float:
        """Standard deviation of the blur [px]; NaN without edges.

        The areas between a step from 0 to 1 that is blurred with the standard deviation σ and the step sum up to
        `σ sqrt(2/π)`. A motion blurs edges across it only, so that the third quartile of all edges is given.
        """
        missing = np.where(ACROSS < 0, self.profile, 1 - self.profile).mean((1, 2))
        blur = 2 * np.linalg.norm(self.across, axis=1) * missing / np.sqrt(2 / np.pi)
        return float(np.nanquantile(blur, 0.75)) if np.isfinite(blur).any() else np.nan

    @property
    def points(self) -> Float64[np.ndarray, "edges crossings 2"]:
        """Where the middle between black and white is on every crossing [px]: half of its area is on either side.

        Where an edge has no contrast, it stays as it is.
        """
        offset = np.nan_to_num(1 - 2 * self.profile.mean(2))
        points: np.ndarray = self.at + offset[..., None] * self.across[:, None]
        return points


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
