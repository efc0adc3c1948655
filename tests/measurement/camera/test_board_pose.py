"""Poses of boards from their corners: exact, with wrong corners, and their covariance."""

import numpy as np
import torch
from testing.camera_cell import BOARD, CAMERA
from testing.closeness import assert_close

from pisigma.estimation.loss import HampelLoss
from pisigma.measurement.camera.board_pose import solve_board_pose
from pisigma.robot.se3 import rotation_from_zyx, rotation_vector

R = rotation_from_zyx(torch.tensor([0.4, 0.5, 3.0], dtype=torch.float64)).numpy()
T = np.array([-0.1, 0.05, 0.5])


def pixels() -> np.ndarray:
    """Return the pixels of the board."""
    return CAMERA.project(BOARD.corners @ R.T + T)[0]


def off(measured: np.ndarray) -> np.ndarray:
    """Return the errors of position [m] and rotation [rad] of the pose from some pixels."""
    pose = solve_board_pose(CAMERA, BOARD.corners, measured, HampelLoss())
    return np.concatenate([pose.t - T, rotation_vector(torch.from_numpy(pose.R @ R.T)).numpy()])


def test_exact_corners_give_the_pose() -> None:
    assert_close(off(pixels()), np.zeros(6), atol=1e-9)


def test_wrong_corners_have_little_weight() -> None:
    rng = np.random.default_rng(0)
    noisy = pixels() + 0.3 * rng.standard_normal(pixels().shape)
    wrong = noisy.copy()
    wrong[::18] += 5.0
    assert np.linalg.norm(off(wrong) - off(noisy)) < 0.5 * np.linalg.norm(off(noisy))


def test_the_covariance_is_that_of_repeated_images() -> None:
    rng = np.random.default_rng(1)
    errors = np.stack([off(pixels() + 0.3 * rng.standard_normal((54, 2))) for _ in range(100)])
    cofactor = solve_board_pose(CAMERA, BOARD.corners, pixels(), HampelLoss()).cofactor
    whitened = np.linalg.solve(np.linalg.cholesky(0.09 * cofactor), errors.T)
    assert_close(whitened @ whitened.T / 100, np.eye(6), atol=0.45)
    assert_close(np.square(whitened).mean(), 1.0, atol=0.15)
