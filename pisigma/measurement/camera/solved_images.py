"""The poses of a board in the images of one camera, and the intrinsics that they show without a robot."""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64

from pisigma.estimation.loss import AbstractLoss, HampelLoss, SquaredLoss
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board_pose import (
    POSE,
    SMALLEST_NOISE,
    BoardPose,
    homography,
    solve_board_pose,
)
from pisigma.measurement.camera.camera import INTRINSICS, USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice
from pisigma.measurement.sensors.intrinsics import ImageIntrinsics, intrinsics_information

ROUNDS = 20
CLOSE = 0.1
"""[standard deviations] Intrinsics that would move by less need not be linearised at anew."""
FREE_FOCAL, FREE_CENTRE = 0.05, 0.05
"""Standard deviations of free intrinsics as shares of the focal lengths and of the width: wider than lenses vary."""
FREE_DISTORTION = (0.3, 1.0, 0.01, 0.01, 3.0)
FEWEST_IMAGES = 3
WIDE = 10.0
"""Times the deviations of free intrinsics, so that nothing but the images counts."""
FIRST = ("fx", "fy", "k1")
CELLS = 8
"""Rows and columns of cells of an image, by which it is said where the board was."""


def prior_deviations(camera: Camera, choice: IntrinsicsChoice) -> Float64[np.ndarray, " 9"]:
    """Return prior standard deviations of a camera's intrinsics [px, and 1 from k1 on], 0 of what is held.

    Args:
        camera: with the deviations that its file states; where it states none, those of a usual calibration.
        choice: "fixed": all are held; "prior": as stated; "free": so wide that the images decide. What "prior" holds is
            held then, too.
    """
    stated = np.array(camera.sigma or USUAL_DEVIATIONS)
    wide = [
        FREE_FOCAL * camera.fx,
        FREE_FOCAL * camera.fy,
        *[FREE_CENTRE * camera.width] * 2,
        *FREE_DISTORTION,
    ]
    free: np.ndarray = np.where(stated > 0, np.maximum(wide, stated), 0.0)
    return {"fixed": np.zeros(len(INTRINSICS)), "prior": stated, "free": free}[choice]


@dataclass(frozen=True, eq=False)
class SolvedImages:
    """The poses of the board in all images of a camera.

    Attributes:
        camera: as its file states it.
        present: with the intrinsics that the poses were solved with.
        sigma: see `prior_deviations`.
        poses: image by image.
        noise: standard deviation of u and v of a corner [px].
    """

    camera: Camera
    present: Camera
    sigma: Float64[np.ndarray, " 9"]
    poses: tuple[BoardPose, ...]
    noise: float

    @property
    def intrinsics(self) -> ImageIntrinsics:
        """What every image says of the intrinsics, the pose's derivatives as its `by_intrinsics` has them."""
        rows = (len(self.poses), len(INTRINSICS))
        stated = (self.present.intrinsics, self.camera.intrinsics, self.sigma)
        return ImageIntrinsics(
            np.stack([pose.by_intrinsics for pose in self.poses]),
            np.stack([pose.root for pose in self.poses]) / self.noise,
            np.stack([pose.rest for pose in self.poses]) / self.noise,
            *(np.broadcast_to(values, rows) for values in stated),
        )


def solve_images(
    camera: Camera,
    sigma: Float64[np.ndarray, " 9"],
    solve: Callable[[Camera], Sequence[BoardPose]],
    loss: AbstractLoss,
    source: str,
) -> SolvedImages:
    """Solve the poses in all images again until the intrinsics are near to those that the images alone show.

    The robot's part in the intrinsics is linear about these: pose and intrinsics of an image are solved together by
    variable projection (Golub and Pereyra 1973), whose steps these are.

    Args:
        camera: as its file states it.
        sigma: see `prior_deviations`.
        solve: gives the poses at some intrinsics.
        loss: how corners count, for their noise.
        source: what complaints call the images.

    Raises:
        MeasurementError: the images and the deviations do not determine the intrinsics.
    """
    present = camera
    for _ in range(ROUNDS):
        poses = tuple(solve(present))
        solved = SolvedImages(camera, present, sigma, poses, corner_noise(poses, loss))
        if not sigma.any():
            return solved
        root, mean = intrinsics_information(solved.intrinsics)
        if np.linalg.norm(root @ (mean - present.intrinsics)) < CLOSE:
            return solved
        if not (np.isfinite(mean).all() and (mean[:2] > 0).all()):
            break
        present = camera.with_intrinsics(mean)
    raise MeasurementError(
        f"{source}: the images do not determine the intrinsics of camera '{camera.name}'; take images up to 40 deg "
        "oblique that fill the whole frame, or hold the intrinsics nearer to a calibration (--intrinsics prior)."
    )


def corner_noise(poses: Sequence[BoardPose], loss: AbstractLoss) -> float:
    """Return the standard deviation of u and v of a corner that the residuals of all images show [px]."""
    distance = torch.from_numpy(np.concatenate([pose.distance for pose in poses]))
    used = float(POSE * len(poses))
    scale = max(float(loss.scale(distance, 2, used)), SMALLEST_NOISE)
    return max(float(loss.deviation(distance, 2, used, scale)), SMALLEST_NOISE)


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
