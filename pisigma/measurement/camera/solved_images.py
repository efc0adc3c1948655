"""Solve the poses of a board in the images of one camera, and the camera's intrinsics without a robot."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from pisigma.estimation.loss import AbstractLoss, HampelLoss, SquaredLoss
from pisigma.files.errors import MeasurementError, Phrase, Place
from pisigma.measurement.camera.board_pose import (
    MIN_NOISE,
    POSE,
    BoardPose,
    homography,
    solve_board_pose,
)
from pisigma.measurement.camera.camera import INTRINSICS, USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice
from pisigma.measurement.sensors.intrinsics import ImageIntrinsics, intrinsics_information

MAX_ITERATIONS = 20
_CONVERGENCE_TOLERANCE = 0.1
"""Change of the intrinsics, in standard deviations, below which they are not relinearised."""
_FREE_FOCAL, _FREE_CENTRE = 0.05, 0.05
"""Prior standard deviations of free focal lengths and principal points, relative to focal length and image width;
lenses vary less."""
_FREE_DISTORTION = (0.3, 1.0, 0.01, 0.01, 3.0)
"""Prior standard deviations of k1, k2, p1, p2 and k3 if they are free."""
_MIN_IMAGES = 3
_UNINFORMATIVE = 10.0
"""Factor on the prior standard deviations of free intrinsics that makes the prior negligible relative to the images."""
FIRST = ("fx", "fy", "k1")
"""Intrinsics that are estimated first."""
_CELLS = 8
"""Number of rows and columns of cells of an image, for its coverage by the board."""


def prior_sigmas(camera: Camera, choice: IntrinsicsChoice) -> Float64[np.ndarray, " 9"]:
    """Return prior standard deviations of a camera's intrinsics [px; distortion without unit], 0 if fixed.

    Args:
        camera: the camera, with the standard deviations of its file or else those of a typical calibration.
        choice: "fixed": all intrinsics are fixed; "prior": standard deviations of the camera; "free": standard
            deviations so large that the images decide. Intrinsics that "prior" fixes are also fixed with "free".
    """
    stated = np.array(camera.sigma or USUAL_DEVIATIONS)
    wide = [
        _FREE_FOCAL * camera.fx,
        _FREE_FOCAL * camera.fy,
        *[_FREE_CENTRE * camera.width] * 2,
        *_FREE_DISTORTION,
    ]
    free: np.ndarray = np.where(stated > 0, np.maximum(wide, stated), 0.0)
    return {"fixed": np.zeros(len(INTRINSICS)), "prior": stated, "free": free}[choice]


@dataclass(frozen=True, eq=False)
class SolvedImages:
    """The poses of the board in all images of a camera.

    Attributes:
        prior_camera: the camera of the file, whose intrinsics are the prior mean.
        camera_of_poses: the camera with the intrinsics with which the poses were solved.
        sigma: prior standard deviations, see `prior_sigmas`.
        poses: pose of the board in every image.
        noise: standard deviation of u and v of a corner [px].
    """

    prior_camera: Camera
    camera_of_poses: Camera
    sigma: Float64[np.ndarray, " 9"]
    poses: tuple[BoardPose, ...]
    noise: float

    @property
    def intrinsics(self) -> ImageIntrinsics:
        """Information of every image on the intrinsics, with the derivatives of its pose."""
        rows = (len(self.poses), len(INTRINSICS))
        stated = (self.camera_of_poses.intrinsics, self.prior_camera.intrinsics, self.sigma)
        return ImageIntrinsics(
            np.stack([pose.intrinsics_jacobian for pose in self.poses]),
            np.stack([pose.information_root for pose in self.poses]) / self.noise,
            np.stack([pose.information_residual for pose in self.poses]) / self.noise,
            *(np.broadcast_to(values, rows) for values in stated),
        )


def solve_images(
    camera: Camera,
    prior_sigma: Float64[np.ndarray, " 9"],
    solve: Callable[[Camera], Sequence[BoardPose]],
    loss: AbstractLoss,
    source: str,
) -> SolvedImages:
    """Solve the poses in all images, and iterate the intrinsics to the estimate of the images alone.

    These are steps of variable projection (Golub and Pereyra 1973), which eliminates the pose of every image. A
    calibration of the robot later linearises the intrinsics at this estimate.

    Args:
        camera: the camera of the file.
        prior_sigma: prior standard deviations, see `prior_sigmas`.
        solve: function that returns the poses for given intrinsics.
        loss: robust loss of the corners, for their noise.
        source: name of the images in messages.

    Raises:
        MeasurementError: the images and the prior do not determine the intrinsics.
    """
    present = camera
    for _ in range(MAX_ITERATIONS):
        poses = tuple(solve(present))
        solved = SolvedImages(camera, present, prior_sigma, poses, corner_noise(poses, loss))
        if not prior_sigma.any():
            return solved
        root, mean = intrinsics_information(solved.intrinsics)
        if np.linalg.norm(root @ (mean - present.intrinsics)) < _CONVERGENCE_TOLERANCE:
            return solved
        if not (np.isfinite(mean).all() and (mean[:2] > 0).all()):
            break
        present = camera.with_intrinsics(mean)
    raise MeasurementError(
        f"the images do not determine the intrinsics of camera '{camera.name}'",
        value=camera.name,
        at=Place(source),
        remedy="take images tilted by up to 40 deg in which the board covers all parts of the frame; to calibrate an "
        "arm, you can also fix the intrinsics (--set intrinsics=fixed)",
    )


def corner_noise(poses: Sequence[BoardPose], loss: AbstractLoss) -> float:
    """Return the standard deviation of u and v of a corner, estimated from the residuals of all images [px]."""
    distance = torch.from_numpy(np.concatenate([pose.residual_length for pose in poses]))
    used = float(POSE * len(poses))
    scale = max(float(loss.scale(distance, 2, used)), MIN_NOISE)
    return max(float(loss.sigma(distance, 2, used, scale)), MIN_NOISE)


@dataclass(frozen=True, eq=False)
class BoardView:
    """Corners of a board, and their pixels in an image.

    Attributes:
        points: corners in the board's frame, z = 0 [m].
        pixels: pixels of the corners in the image [px].
    """

    points: Float64[np.ndarray, "corners 3"]
    pixels: Float64[np.ndarray, "corners 2"]


@dataclass(frozen=True, eq=False)
class IntrinsicCalibration:
    """Result of the calibration of a camera with images of a board.

    Attributes:
        camera: the calibrated camera, with standard deviations of its intrinsics.
        noise: standard deviation of u and v of a corner [px].
        tilts: angle between the board's normal and the camera's axis in every image [rad].
        scatter_ratio: ratio of the images' scatter about common intrinsics to their noise (Birge 1932): it is 1 if
            the model fits, and larger for a bowed board. Standard deviations are multiplied by it.
        has_excess_scatter: whether the ratio is larger than chance explains (three standard deviations).
        covered_cells: whether a corner was seen in each cell of the image, row by row.
    """

    camera: Camera
    noise: float
    tilts: Float64[np.ndarray, " images"]
    scatter_ratio: float
    has_excess_scatter: bool
    covered_cells: Bool[np.ndarray, "cells cells"]


def calibrate_intrinsics(
    views: Sequence[BoardView], name: str, size: tuple[int, int], free_k3: bool = False
) -> IntrinsicCalibration:
    """Fit the intrinsics and all poses of the board to its corners.

    The focal lengths and k1 are estimated first, because the other intrinsics diverge far from the solution; the last
    fit is robust.

    Args:
        views: the board in every image.
        name: name of the camera.
        size: width and height of the images [px].
        free_k3: whether to estimate k3; otherwise k3 is 0.

    Raises:
        MeasurementError: the images do not determine the intrinsics.
    """
    if len(views) < _MIN_IMAGES:
        raise MeasurementError(
            expected=f"{_MIN_IMAGES} or more images of the board",
            value=len(views),
            remedy="take 20, tilted by up to 40 deg",
        )
    start = initial_camera(views, name, size)
    everything = INTRINSICS if free_k3 else INTRINSICS[:-1]
    for names, loss in ((FIRST, SquaredLoss()), (everything, SquaredLoss()), (everything, HampelLoss())):
        solved = _solved(views, start, names, loss)
        root, mean = intrinsics_information(solved.intrinsics)
        start = start.with_intrinsics(mean)
    free = np.flatnonzero(solved.sigma)
    sigma = np.zeros(len(mean))
    residual = solved.intrinsics.information_residual
    freedom = residual.size - len(free)
    disagreement = float(np.sqrt(np.square(residual).sum() / freedom))
    sigma[free] = max(disagreement, 1.0) * np.linalg.norm(np.linalg.inv(root[np.ix_(free, free)]), axis=1)
    return IntrinsicCalibration(
        camera=replace(start, sigma=tuple(sigma.tolist())),
        noise=solved.noise,
        tilts=np.array([np.arccos(min(abs(pose.R[2, 2]), 1.0)) for pose in solved.poses]),
        scatter_ratio=disagreement,
        has_excess_scatter=disagreement > 1 + 3 / math.sqrt(2 * freedom),
        covered_cells=_covered(views, size),
    )


def initial_camera(views: Sequence[BoardView], name: str, size: tuple[int, int]) -> Camera:
    """Estimate one focal length in closed form, with the principal point in the middle and no distortion (Zhang 2000).

    The homography `h1 h2 h3` of a board satisfies `h1 . h2 = 0` and `|h1| = |h2|` if its first two rows are divided by
    the focal length.

    Raises:
        MeasurementError: all images show the board frontally, so they do not determine the focal length.
    """
    middle, width = (np.array(size) - 1) / 2, float(size[0])
    slopes, constants = list[float](), list[float]()
    for view in views:
        H = homography(view.points[:, :2], (view.pixels - middle) / width)
        # rows are scaled so that all images have similar weights
        h1, h2 = H[:, :2].T / np.linalg.norm(H[:2, :2])
        slopes += [h1[:2] @ h2[:2], h1[:2] @ h1[:2] - h2[:2] @ h2[:2]]
        constants += [h1[2] * h2[2], h1[2] ** 2 - h2[2] ** 2]
    squared = -(np.dot(slopes, constants) / np.dot(slopes, slopes))
    if not squared > 0:
        raise MeasurementError(
            expected="oblique images of the board, which determine the focal length",
            value=Phrase("perpendicular ones"),
            remedy="take images tilted by up to 40 deg",
        )
    focal = width / np.sqrt(squared)
    return Camera(name, *size, focal, focal, *middle.tolist())


def _solved(
    views: Sequence[BoardView], start: Camera, names: Collection[str], loss: AbstractLoss
) -> SolvedImages:
    """Solve all poses and the intrinsics in `names`; other intrinsics are fixed."""
    sigma = _UNINFORMATIVE * prior_sigmas(replace(start, sigma=(1.0,) * len(INTRINSICS)), "free")
    sigma *= [name in names for name in INTRINSICS]

    def poses(camera: Camera) -> list[BoardPose]:
        return [solve_board_pose(camera, view.points, view.pixels, loss) for view in views]

    return solve_images(start, sigma, poses, loss, "the images")


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> Bool[np.ndarray, "cells cells"]:
    """Return whether each cell of the image contains a corner of any view."""
    covered = np.zeros((_CELLS, _CELLS), dtype=bool)
    for view in views:
        cell = np.clip(_CELLS * (view.pixels + 0.5) / size, 0, _CELLS - 1).astype(int)
        covered[cell[:, 1], cell[:, 0]] = True
    return covered
