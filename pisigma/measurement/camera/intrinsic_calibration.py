"""The intrinsics of a camera from images of a board alone, without a robot."""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from pisigma.estimation.loss import AbstractLoss, HampelLoss, SquaredLoss
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board_pose import BoardPose, homography, solve_board_pose
from pisigma.measurement.camera.camera import INTRINSICS, Camera
from pisigma.measurement.camera.solved_images import SolvedImages, prior_deviations, solve_images
from pisigma.measurement.sensors.intrinsics import intrinsics_information

FEWEST_IMAGES = 3
WIDE = 10.0
"""Times the deviations of free intrinsics, so that nothing but the images counts."""
FIRST = ("fx", "fy", "k1")
CELLS = 8
"""Rows and columns of cells of an image, by which it is said where the board was."""


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in an image.

    Attributes:
        points: corners in the board's frame, z = 0 [m].
        pixels: where the image shows them [px].
    """

    points: Float64[np.ndarray, "corners 3"]
    pixels: Float64[np.ndarray, "corners 2"]


@dataclass(frozen=True, eq=False)
class IntrinsicCalibration:
    """A camera as its images of a board show it.

    Attributes:
        camera: with standard deviations.
        noise: standard deviation of u and v of a corner [px].
        tilts: angle between the board's normal and the camera's axis in every image [rad].
        disagreement: by how many times their noise images disagree on the intrinsics (Birge 1932): 1 where the model
            fits, more of a bowed board. Standard deviations are enlarged by it.
        disagrees: whether that is more than chance (three standard deviations).
        covered: cells of the image, row by row, in which there was a corner in some image.
    """

    camera: Camera
    noise: float
    tilts: Float64[np.ndarray, " images"]
    disagreement: float
    disagrees: bool
    covered: Bool[np.ndarray, "cells cells"]


def calibrate_intrinsics(
    views: Sequence[BoardView], name: str, size: tuple[int, int], free_k3: bool = False
) -> IntrinsicCalibration:
    """Fit intrinsics and all poses of the board to its corners.

    The focal lengths and k1 come first, as far from the solution the others lead astray; the last fit is robust.

    Args:
        views: the board in every image.
        name: of the camera.
        size: width and height of the images [px].
        free_k3: whether k3 is identified; else it is 0.

    Raises:
        MeasurementError: the images do not determine the intrinsics.
    """
    if len(views) < FEWEST_IMAGES:
        raise MeasurementError(
            f"{FEWEST_IMAGES} images of the board or more were wanted, got {len(views)}; take 20 up to 40 deg oblique."
        )
    start = initial_camera(views, name, size)
    everything = INTRINSICS if free_k3 else INTRINSICS[:-1]
    for names, loss in ((FIRST, SquaredLoss()), (everything, SquaredLoss()), (everything, HampelLoss())):
        solved = _solved(views, start, names, loss)
        root, mean = intrinsics_information(solved.intrinsics)
        start = start.with_intrinsics(mean)
    free = np.flatnonzero(solved.sigma)
    sigma = np.zeros(len(mean))
    rest = solved.intrinsics.residual
    freedom = rest.size - len(free)
    disagreement = float(np.sqrt(np.square(rest).sum() / freedom))
    sigma[free] = max(disagreement, 1.0) * np.linalg.norm(np.linalg.inv(root[np.ix_(free, free)]), axis=1)
    return IntrinsicCalibration(
        camera=replace(start, sigma=tuple(sigma.tolist())),
        noise=solved.noise,
        tilts=np.array([np.arccos(min(abs(pose.R[2, 2]), 1.0)) for pose in solved.poses]),
        disagreement=disagreement,
        disagrees=disagreement > 1 + 3 / math.sqrt(2 * freedom),
        covered=_covered(views, size),
    )


def initial_camera(views: Sequence[BoardView], name: str, size: tuple[int, int]) -> Camera:
    """Find one focal length in closed form, with the principal point in the middle and no distortion (Zhang 2000).

    Of the homography `h1 h2 h3` of a board, `h1 . h2 = 0` and `|h1| = |h2|` where the first two rows are divided by the
    focal length.

    Raises:
        MeasurementError: all images look straight at the board, so that they do not determine it.
    """
    middle, width = (np.array(size) - 1) / 2, float(size[0])
    slopes, constants = list[float](), list[float]()
    for view in views:
        H = homography(view.points[:, :2], (view.pixels - middle) / width)
        h1, h2 = H[:, :2].T / np.linalg.norm(H[:2, :2])
        slopes += [h1[:2] @ h2[:2], h1[:2] @ h1[:2] - h2[:2] @ h2[:2]]
        constants += [h1[2] * h2[2], h1[2] ** 2 - h2[2] ** 2]
    squared = -(np.dot(slopes, constants) / np.dot(slopes, slopes))
    if not squared > 0:
        raise MeasurementError(
            "the images do not determine a focal length, as all look straight at the board; take oblique ones."
        )
    focal = width / np.sqrt(squared)
    return Camera(name, *size, focal, focal, *middle.tolist())


def _solved(
    views: Sequence[BoardView], start: Camera, names: Collection[str], loss: AbstractLoss
) -> SolvedImages:
    """Solve all poses and the intrinsics of some names, with the others as they are."""
    sigma = WIDE * prior_deviations(replace(start, sigma=(1.0,) * len(INTRINSICS)), "free")
    sigma *= [name in names for name in INTRINSICS]

    def poses(camera: Camera) -> list[BoardPose]:
        return [solve_board_pose(camera, view.points, view.pixels, loss) for view in views]

    return solve_images(start, sigma, poses, loss, "the images")


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> Bool[np.ndarray, "cells cells"]:
    """Which cells of the image hold a corner of some view."""
    covered = np.zeros((CELLS, CELLS), dtype=bool)
    for view in views:
        cell = np.clip(CELLS * (view.pixels + 0.5) / size, 0, CELLS - 1).astype(int)
        covered[cell[:, 1], cell[:, 0]] = True
    return covered
