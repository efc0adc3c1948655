"""Corners of a board in an image: refined to sub-pixel, and how blurred the edges between them are."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8
from scipy.ndimage import map_coordinates

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.board_pose import FEWEST_CORNERS
from pisigma.measurement.camera.detection.saddle import fit_saddles

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
