"""The pose of a board in one image, and its covariance."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64

from pisigma.estimation.loss import AbstractLoss
from pisigma.measurement.camera.camera import Camera
from pisigma.robot.se3 import nearest_rotation, rotation_from_vector, skew

MIN_CORNERS = 6
"""Smallest number of corners in an image: four determine the pose, and two more reveal a wrong corner."""
MAX_ITERATIONS = 20
STEP_TOLERANCE = 1e-10
"""Size of a Gauss-Newton step [m or rad] below which the iteration ends."""
MIN_NOISE = 1e-6
"""Lower bound of the estimated noise of corners [px], for corners without noise."""
POSE = 6
"""Number of parameters of a pose."""


@dataclass(frozen=True, eq=False)
class BoardPose:
    """The pose of a board relative to a camera, with its covariance.

    Attributes:
        R: rotation R_camera_board.
        t: origin of the board in the camera's frame [m].
        cofactor: covariance of the pose error (shift of t [m], rotation vector of R in the camera's frame [rad]) if
            the noise of the corners is 1 px.
        residual_length: length of every corner's residual, divided by the relative standard deviation of the corner
            [px].
        robust_weight: weight of every corner by the robust loss.
        intrinsics_jacobian: derivative of the solved pose (shift of t [m], rotation vector of R in the camera's frame
            [rad]) with respect to the intrinsics.
        information_root: square root of the corners' information on the intrinsics k, with the pose eliminated and a
            noise of 1 px: `root (k - k0) = information_residual` with the intrinsics k0 of the camera.
        information_residual: right-hand side of the equation of `information_root` [px].
    """

    R: Float64[np.ndarray, "3 3"]
    t: Float64[np.ndarray, " 3"]
    cofactor: Float64[np.ndarray, "6 6"]
    residual_length: Float64[np.ndarray, " corners"]
    robust_weight: Float64[np.ndarray, " corners"]
    intrinsics_jacobian: Float64[np.ndarray, "6 9"]
    information_root: Float64[np.ndarray, "9 9"]
    information_residual: Float64[np.ndarray, " 9"]


def solve_board_pose(
    camera: Camera,
    corners: Float64[np.ndarray, "corners 3"],
    pixels: Float64[np.ndarray, "corners 2"],
    loss: AbstractLoss,
    relative_sigma: Float64[np.ndarray, " corners"] | None = None,
) -> BoardPose:
    """Find the pose of a flat board by Gauss-Newton steps, from the homography of its corners (Zhang 2000).

    A shift δ and a rotation vector ω move the point `P = R X + t` of a corner X by `δ + ω × R X`.

    Args:
        camera: the camera, whose intrinsics are fixed here.
        corners: corners in the frame of the board [m], all with z near 0 and not on one line.
        pixels: their pixels in the image [px].
        loss: robust loss of the corners' residuals.
        relative_sigma: standard deviation of every corner relative to the median; None if all are equal.
    """
    relative_sigma = np.ones(len(pixels)) if relative_sigma is None else relative_sigma
    R, t = _by_homography(corners, camera.undistort(pixels))
    for _ in range(MAX_ITERATIONS):
        residual, J, _ = linearise_pixels(camera, corners, pixels, relative_sigma, R, t)
        root = np.sqrt(_weights(residual, loss))[:, None]
        A, b = (root[..., None] * J).reshape(-1, POSE), (root * residual).ravel()
        step = np.linalg.solve(A.T @ A, A.T @ b)
        t, R = t + step[:3], rotation_from_vector(torch.from_numpy(step[3:])).numpy() @ R
        if np.abs(step).max() < STEP_TOLERANCE:
            break
    residual, J, _ = linearise_pixels(camera, corners, pixels, relative_sigma, R, t)
    weight = _weights(residual, loss)
    intrinsics_jacobian = camera.intrinsics_jacobian(corners @ R.T + t) / relative_sigma[:, None, None]
    columns = np.concatenate([J, intrinsics_jacobian, residual[..., None]], -1)
    # blocks of the factor: pose, intrinsics after elimination of the pose, and the residual as last column
    factor = triangular_factor((np.sqrt(weight)[:, None, None] * columns).reshape(-1, columns.shape[-1]))
    inverse = np.linalg.inv(factor[:POSE, :POSE])
    return BoardPose(
        R,
        t,
        inverse @ inverse.T,
        np.linalg.norm(residual, axis=1),
        weight,
        intrinsics_jacobian=-inverse @ factor[:POSE, POSE:-1],
        information_root=factor[POSE:-1, POSE:-1],
        information_residual=factor[POSE:-1, -1],
    )


def triangular_factor(
    columns: Float64[np.ndarray, "values columns"],
) -> Float64[np.ndarray, "columns columns"]:
    """Return the triangular factor R of a QR decomposition, which is square even if there are fewer rows than columns.

    With the pose in the first columns, the rows after `POSE` are the equations of the other unknowns with the pose
    eliminated.
    """
    count = columns.shape[1]
    padded = np.concatenate([columns, np.zeros((count, count))])
    factor: np.ndarray = np.linalg.qr(padded, mode="r")  # type: ignore[assignment]
    return factor


def linearise_pixels(
    camera: Camera,
    corners: np.ndarray,
    pixels: np.ndarray,
    relative_sigma: np.ndarray,
    R: np.ndarray,
    t: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return measured minus predicted pixels, and derivatives with respect to pose and point, all divided by sigma."""
    rotated = corners @ R.T
    predicted, point_jacobian = camera.project(rotated + t)
    rotation_jacobian = -point_jacobian @ skew(torch.from_numpy(rotated)).numpy()
    J = np.concatenate([point_jacobian, rotation_jacobian], -1)
    return (
        (pixels - predicted) / relative_sigma[:, None],
        J / relative_sigma[:, None, None],
        point_jacobian / relative_sigma[:, None, None],
    )


def _weights(residual: np.ndarray, loss: AbstractLoss) -> np.ndarray:
    distance = torch.from_numpy(np.linalg.norm(residual, axis=1))
    scale = max(float(loss.scale(distance, 2, float(POSE))), MIN_NOISE)
    weights: np.ndarray = loss.weight(distance / scale, 2).numpy()
    return weights


def homography(
    plane: Float64[np.ndarray, "corners 2"], image: Float64[np.ndarray, "corners 2"]
) -> Float64[np.ndarray, "3 3"]:
    """Find the homography H with `image ~ H (x, y, 1)` by the direct linear transform, with positive depths.

    Args:
        plane: points on a plane, in any unit.
        image: their images, as x / z and y / z or scaled to about 1.
    """
    middle, size = plane.mean(0), np.ptp(plane, axis=0).max()  # normalised, for the condition of A
    at = np.concatenate([(plane - middle) / size, np.ones((len(plane), 1))], 1)
    zero = np.zeros_like(at)
    A = np.concatenate(
        [
            np.concatenate([at, zero, -image[:, :1] * at], 1),
            np.concatenate([zero, at, -image[:, 1:] * at], 1),
        ]
    )
    H: np.ndarray = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(3, 3)
    H *= np.sign(H[2, 2]) / np.array([size, size, 1.0])
    H[:, 2] -= H[:, :2] @ middle
    return H


def _by_homography(corners: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of a flat board from `ray ~ [r1 r2 t] (x, y, 1)`."""
    H = homography(corners[:, :2], rays)
    middle = corners[:, :2].mean(0)
    H = 2 * H / (np.linalg.norm(H[:, 0]) + np.linalg.norm(H[:, 1]))
    R = np.column_stack([H[:, :2], np.cross(H[:, 0], H[:, 1])])
    R = nearest_rotation(torch.from_numpy(R)).numpy()
    return R, H[:, 2] + (H[:, :2] - R[:, :2]) @ middle
