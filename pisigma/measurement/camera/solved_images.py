"""The poses of a board in the images of one camera, at intrinsics near to those that the images show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.estimation.loss import AbstractLoss
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.board_pose import POSE, SMALLEST_NOISE, BoardPose
from pisigma.measurement.camera.camera import INTRINSICS, USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice
from pisigma.measurement.sensors.intrinsics import ImageIntrinsics, intrinsics_information

ROUNDS = 20
CLOSE = 0.1
"""[standard deviations] Intrinsics that would move by less need not be linearised at anew."""
FREE_FOCAL, FREE_CENTRE = 0.05, 0.05
"""Standard deviations of free intrinsics as shares of the focal lengths and of the width: wider than lenses vary."""
FREE_DISTORTION = (0.3, 1.0, 0.01, 0.01, 3.0)


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
