"""Boards that are bent or have a wrong scale, and rendering of their images."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8
from scipy.ndimage import gaussian_filter

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.pattern import Pattern, printed_pattern
from pisigma.robot.se3 import rotation_from_vector, transform

_NODE_STEP = 16
"""Distance [px] between the nodes at which rays are undistorted; a cubic spline between these is accurate to 1e-4
px."""
_SURFACE_ITERATIONS = 4
"""Number of fixed-point iterations from the plane to a bowed surface; each reduces the error to a few percent."""
_SUBPIXELS = 4
"""Number of subpixels in each direction of a pixel that contains an edge."""
_BLUR_LEVELS = 4
"""Number of blurred images, from the sharpest to the most blurred, between which pixels are interpolated."""
_MIN_BLUR_STEP = 1e-3
"""Smallest difference between blur levels [px], for images of constant blur."""
_MIN_COSINE = 1e-9
"""Lower bound of the cosine of the angle between a ray and the board's normal, for rays almost parallel to the
board."""
FAR = 1e6
"""Depth [m] that is assigned to rays that do not meet the board."""
_OUTLINE = 20
"""Number of points per edge of the sheet from which the bounds of its image are computed."""


@dataclass(frozen=True)
class TrueBoard:
    """A printed board that differs from its description.

    The surface is `z = bow · r² / R²`, where r is the distance from the centre of the corners and R is the distance
    of the farthest corner.

    Attributes:
        described_board: the board as described in its file.
        scale: ratio of true to described lengths.
        bow: height of the farthest corners above the plane at the centre [m], along z.
    """

    described_board: Board
    scale: float = 1.0
    bow: float = 0.0

    @property
    def corners(self) -> Float64[np.ndarray, "corners 3"]:
        """True positions of the corners in the board's frame [m]."""
        flat = self.scale * self.described_board.corners[:, :2]
        return np.concatenate([flat, self.height(flat)[:, None]], 1)

    @property
    def pattern(self) -> Pattern:
        """Printed pattern of the board at its true size."""
        stated = printed_pattern(self.described_board)
        return Pattern(self.scale * stated.black_rectangles, self.scale * stated.sheet_rectangle)

    def height(self, xy: Float64[np.ndarray, "*batch 2"]) -> Float64[np.ndarray, "*batch"]:
        """Return z of the surface [m] at points of the plane [m]."""
        corners = self.scale * self.described_board.corners[:, :2]
        middle = corners.mean(0)
        farthest = np.square(corners - middle).sum(1).max()
        z: np.ndarray = self.bow * np.square(xy - middle).sum(-1) / farthest
        return z


@dataclass(frozen=True)
class Exposure:
    """Light and optics with which an image is taken.

    A lens with aperture A and focal length f [px], focused at the distance F, images a point at the distance z as a
    disc with the diameter `f A |1/z - 1/F|`; here the disc is replaced by a normal density with the same variance.

    Attributes:
        black: gray level of the print, from 0 to 255.
        white: gray level of the paper, from 0 to 255.
        background: gray level around the board, from 0 to 255.
        blur_in_focus: standard deviation of the blur in focus [px].
        focus_distance: distance in focus [m].
        aperture_diameter: diameter of the aperture of the lens [m].
        vignetting: relative loss of light in the corners of the image.
        gradient: change of the light from the left to the right edge of the image, relative to its mean.
        noise: standard deviation of the gray level of a pixel.
    """

    black: float = 30.0
    white: float = 200.0
    background: float = 110.0
    blur_in_focus: float = 0.7
    focus_distance: float = 0.5
    aperture_diameter: float = 0.001
    vignetting: float = 0.2
    gradient: float = 0.2
    noise: float = 2.0


def render_image(
    camera: Camera,
    board: TrueBoard,
    T_camera_board: Float64[np.ndarray, "4 4"],
    exposure: Exposure,
    rng: np.random.Generator,
    rolling_shutter_motion: Float64[np.ndarray, " 6"] | None = None,
) -> UInt8[np.ndarray, "height width"]:
    """Render the gray image that a camera takes of a board, without occlusions.

    Args:
        camera: the camera with its true intrinsics.
        board: the true board.
        T_camera_board: pose of the board [m].
        exposure: light and optics.
        rng: random generator of the noise.
        rolling_shutter_motion: motion of the board, shift [m] and rotation vector [rad] in the axes of the camera,
            between the first and the last row of the image, which a rolling shutter exposes one after the other; None
            if the board is at rest. The middle row shows the given pose.

    Returns:
        Gray level of every pixel, from 0 to 255.
    """
    gray = np.full((camera.height, camera.width), exposure.background, dtype=np.float32)
    moved = [_moved(T_camera_board, rolling_shutter_motion, np.array([share]))[0] for share in (-0.5, 0.5)]
    bounds = np.array(
        [
            _bounds(camera, board, T, exposure)
            for T in (moved if rolling_shutter_motion is not None else moved[:1])
        ]
    )
    (left, top), (right, bottom) = bounds[:, :2].min(0).tolist(), bounds[:, 2:].max(0).tolist()
    if left < right and top < bottom:
        rows = np.arange(top, bottom + 1) - 0.5
        rays = _rays(camera, np.arange(left, right + 1) - 0.5, rows)
        xy, depth = _on_surface(
            board, _moved(T_camera_board, rolling_shutter_motion, rows / camera.height - 0.5), rays
        )
        sharp = _reflected(_Surface.from_pattern(board.pattern, exposure), xy)
        gray[top:bottom, left:right] = _blurred(sharp, _blur(camera, exposure, depth[1:, 1:]))
    gray *= _light(camera, exposure)
    gray += exposure.noise * rng.standard_normal(gray.shape, dtype=np.float32)
    return np.clip(np.rint(gray), 0, 255).astype(np.uint8)


def _moved(
    T: Float64[np.ndarray, "4 4"],
    motion: Float64[np.ndarray, " 6"] | None,
    share: Float64[np.ndarray, " rows"],
) -> Float64[np.ndarray, "_rows 4 4"]:
    """Return a pose after shares of a motion; one pose for all rows if there is no motion."""
    if motion is None:
        return T[None]
    along = torch.from_numpy(share[:, None] * motion)
    R = rotation_from_vector(along[:, 3:]) @ torch.tensor(T[:3, :3])
    moved: np.ndarray = transform(R, along[:, :3] + torch.tensor(T[:3, 3])).numpy()
    return moved


def _blur(camera: Camera, exposure: Exposure, depth: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the blur [px] at a depth [m], a quarter of a blurred disc's diameter."""
    disc = camera.fx * exposure.aperture_diameter * np.abs(1 / depth - 1 / exposure.focus_distance)
    blur: np.ndarray = np.hypot(exposure.blur_in_focus, disc / 4)
    return blur


def _bounds(
    camera: Camera, board: TrueBoard, T_camera_board: np.ndarray, exposure: Exposure
) -> tuple[int, int, int, int]:
    """Return the range of pixels that the blurred board covers, or the whole image if the board leaves the view."""
    left, top, right, bottom = board.pattern.sheet_rectangle
    along = np.linspace(0, 1, _OUTLINE)
    x, y = left + along * (right - left), top + along * (bottom - top)
    edges = [(x, np.full_like(x, end)) for end in (top, bottom)]
    edges += [(np.full_like(y, end), y) for end in (left, right)]
    xy = np.concatenate([np.stack(edge, -1) for edge in edges])
    points = np.concatenate([xy, board.height(xy)[:, None]], 1) @ T_camera_board[:3, :3].T
    points += T_camera_board[:3, 3]
    size = np.array([camera.width, camera.height])
    if (points[:, 2] <= 0).any():
        return 0, 0, camera.width, camera.height
    pixels = camera.project(points)[0]
    if (np.abs(pixels - size / 2) > size).any():  # far outside of the image, the distortion is not monotonic
        return 0, 0, camera.width, camera.height
    margin = 2 + 4 * float(_blur(camera, exposure, points[:, 2]).max())
    first = np.maximum(np.floor(pixels.min(0) - margin), 0).astype(int)
    last = np.minimum(np.ceil(pixels.max(0) + margin) + 1, size).astype(int)
    return int(first[0]), int(first[1]), int(last[0]), int(last[1])


def _rays(camera: Camera, u: np.ndarray, v: np.ndarray) -> Float64[np.ndarray, "2 v u"]:
    """Return x / z and y / z of the rays of a grid of pixels."""
    # imported here, because it takes 0.3 s, and other recipes do not need it
    from scipy.interpolate import (
        RectBivariateSpline,
    )

    nodes_u, nodes_v = (np.linspace(at[0], at[-1], 4 + int((at[-1] - at[0]) / _NODE_STEP)) for at in (u, v))
    at_nodes = camera.undistort(np.stack(np.meshgrid(nodes_u, nodes_v), -1))
    return np.stack([RectBivariateSpline(nodes_v, nodes_u, at_nodes[..., axis])(v, u) for axis in (0, 1)])


def _on_surface(
    board: TrueBoard, T_camera_board: Float64[np.ndarray, "_rows 4 4"], rays: np.ndarray
) -> tuple[Float64[np.ndarray, "2 v u"], Float64[np.ndarray, "v u"]]:
    """Return the points at which rays meet the board, in its frame [m], and their depths [m].

    The depth is `FAR` if a ray does not meet the board. There is one pose of the board for each row of rays, or one for
    all.
    """
    R, t = T_camera_board[:, :3, :3, None], T_camera_board[:, :3, 3, None]
    origin = [-(R[:, :, axis] * t).sum(1) for axis in range(3)]
    along = [R[:, 0, axis] * rays[0] + R[:, 1, axis] * rays[1] + R[:, 2, axis] for axis in range(3)]
    facing = np.copysign(np.maximum(np.abs(along[2]), _MIN_COSINE), along[2])
    depth = -origin[2] / facing
    for _ in range(_SURFACE_ITERATIONS if board.bow else 0):
        xy = np.stack([origin[axis] + depth * along[axis] for axis in (0, 1)], -1)
        depth = (board.height(xy) - origin[2]) / facing
    depth[depth <= 0] = FAR
    return np.stack([origin[axis] + depth * along[axis] for axis in (0, 1)]), depth


def _reflected(surface: "_Surface", xy: Float64[np.ndarray, "2 v u"]) -> Float64[np.ndarray, "v-1 u-1"]:
    """Return the gray level of every pixel before the blur, averaged over its area, from its four vertices."""
    cell = surface.cell(xy)
    gray: np.ndarray = surface.gray.ravel()[cell[:-1, :-1]]
    across = (cell[:-1, :-1] != cell[1:, 1:]) | (cell[:-1, 1:] != cell[1:, :-1])
    a, b, c, d = (
        xy[:, rows, columns][:, across]
        for rows in (slice(None, -1), slice(1, None))
        for columns in (slice(None, -1), slice(1, None))
    )
    centre, along_u, along_v = (a + b + c + d) / 4, (b - a + d - c) / 2, (c - a + d - b) / 2
    half = (np.abs(along_u) + np.abs(along_v)) / 2 / _SUBPIXELS
    total = np.zeros(centre.shape[1])
    offsets = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    for du in offsets:
        for dv in offsets:
            total += surface.mean(centre + du * along_u + dv * along_v, half)
    gray[across] = total / _SUBPIXELS**2
    return gray


@dataclass(frozen=True, eq=False)
class _Surface:
    """Gray levels of a sheet as a grid of rectangular cells, with their integral.

    Attributes:
        x: edges between columns of cells [m].
        y: edges between rows of cells [m].
        gray: gray level of every cell, including cells around the sheet.
        integral: integral of gray minus background over the area left of and above every intersection of edges [m²].
        background: gray level around the sheet.
    """

    x: np.ndarray
    y: np.ndarray
    gray: np.ndarray
    integral: np.ndarray
    background: float

    @staticmethod
    def from_pattern(pattern: Pattern, exposure: Exposure) -> "_Surface":
        """Return the grid of a sheet with a printed pattern."""
        rectangles = np.concatenate([pattern.sheet_rectangle[None], pattern.black_rectangles])
        x, y = np.unique(rectangles[:, [0, 2]]), np.unique(rectangles[:, [1, 3]])
        columns, rows = np.searchsorted(x, rectangles[:, [0, 2]]), np.searchsorted(y, rectangles[:, [1, 3]])
        gray = np.full((len(y) + 1, len(x) + 1), exposure.background)
        for number, ((left, right), (top, bottom)) in enumerate(zip(columns, rows, strict=True)):
            level = exposure.black if number else exposure.white
            gray[top + 1 : bottom + 1, left + 1 : right + 1] = level
        cells = (gray[1:-1, 1:-1] - exposure.background) * np.diff(y)[:, None] * np.diff(x)
        integral = np.pad(cells.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        return _Surface(x, y, gray, integral, exposure.background)

    def cell(self, xy: np.ndarray) -> np.ndarray:
        """Return the indices of the cell that contains a point."""
        column, row = np.searchsorted(self.x, xy[0]), np.searchsorted(self.y, xy[1])
        number: np.ndarray = row * self.gray.shape[1] + column
        return number

    def mean(self, xy: np.ndarray, half: np.ndarray) -> np.ndarray:
        """Return the mean gray level of rectangles with the centres `xy` and half the sides `half`."""
        (left, top), (right, bottom) = xy - half, xy + half
        total = self._integral(right, bottom) - self._integral(left, bottom)
        total -= self._integral(right, top) - self._integral(left, top)
        gray: np.ndarray = total / (4 * half.prod(0)) + self.background
        return gray

    def _integral(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the integral of gray levels left of x and above y, bilinear within every cell."""
        column, a = _cell(self.x, x)
        row, b = _cell(self.y, y)
        upper = (1 - a) * self.integral[row, column] + a * self.integral[row, column + 1]
        lower = (1 - a) * self.integral[row + 1, column] + a * self.integral[row + 1, column + 1]
        total: np.ndarray = (1 - b) * upper + b * lower
        return total


def _cell(edges: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the cell that contains a coordinate, and the relative position in it, from 0 to 1."""
    at = np.clip(at, edges[0], edges[-1])
    index = np.clip(np.searchsorted(edges, at) - 1, 0, len(edges) - 2)
    return index, (at - edges[index]) / (edges[index + 1] - edges[index])


def _blurred(sharp: np.ndarray, blur: np.ndarray) -> np.ndarray:
    """Blur every pixel by its standard deviation, interpolating between a few blurred images."""
    levels = np.linspace(blur.min(), max(blur.max(), blur.min() + _MIN_BLUR_STEP), _BLUR_LEVELS)
    weight = (blur - levels[0]) / (levels[1] - levels[0])
    total = np.zeros_like(sharp)
    for number, level in enumerate(levels):
        total += np.maximum(1 - np.abs(weight - number), 0) * gaussian_filter(sharp, level, mode="nearest")
    return total


def _light(camera: Camera, exposure: Exposure) -> Float[np.ndarray, "height width"]:
    """Return the light at every pixel, relative to the light at the centre of the image."""
    u = (np.arange(camera.width, dtype=np.float32) + 0.5) / camera.width - 0.5
    v = (np.arange(camera.height, dtype=np.float32) + 0.5) / camera.height - 0.5
    radius = (u**2 * camera.width**2 + v[:, None] ** 2 * camera.height**2) * (
        4 / (camera.width**2 + camera.height**2)
    )
    light: np.ndarray = (1 - exposure.vignetting * radius) * (1 + exposure.gradient * u)
    return light
