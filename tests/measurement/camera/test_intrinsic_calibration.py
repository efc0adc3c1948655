"""Intrinsics from images of a board alone: compared with OpenCV, their deviations, and insufficient images."""

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.solved_images import (
    BoardView,
    IntrinsicCalibration,
    calibrate_intrinsics,
    initial_camera,
)
from pisigma.robot.se3 import rotation_from_zyx
from pisigma.simulation.camera.rendering import TrueBoard

SIZE = (1920, 1200)
TRUE = Camera("wrist", *SIZE, 1400.0, 1405.0, 980.0, 590.0, -0.3, 0.08, 1e-3, -5e-4)
NOISE = 0.2
"""[px]"""


def views(count: int, tilt: float, seed: int = 0, noise: float = NOISE, bow: float = 0.0) -> list[BoardView]:
    """Return views of the complete board from 0.3 to 0.5 m anywhere in the image, up to an angle `oblique` [rad]."""
    rng, chosen = np.random.default_rng(seed), list[BoardView]()
    while len(chosen) < count:
        rpy = np.append(rng.uniform(-np.pi, np.pi), rng.uniform(-tilt, tilt, 2))
        R = rotation_from_zyx(torch.from_numpy(rpy)).numpy()
        t = rng.uniform((-0.15, -0.1, 0.3), (0.15, 0.1, 0.5)) - R @ BOARD.corners.mean(0)
        pixels = TRUE.project(TrueBoard(BOARD, bow=bow).corners @ R.T + t)[0]
        if (pixels > 0).all() and (pixels < SIZE).all():
            chosen.append(BoardView(BOARD.corners, pixels + noise * rng.standard_normal(pixels.shape)))
    return chosen


@pytest.fixture(scope="module")
def calibration() -> IntrinsicCalibration:
    """A calibration with 12 images of a flat board."""
    return calibrate_intrinsics(views(12, 0.6), "wrist", SIZE)


def test_deviations_are_those_of_the_errors(calibration: IntrinsicCalibration) -> None:
    sigma = np.array(calibration.camera.sigma)
    errors = (calibration.camera.intrinsics - TRUE.intrinsics)[:8] / sigma[:8]
    assert np.abs(errors).max() < 3.5
    assert 0.5 < np.sqrt(np.square(errors).mean()) < 1.6
    assert (calibration.camera.k3, sigma[8]) == (0.0, 0.0)
    assert_close(calibration.noise, NOISE, rtol=0.1)
    assert 0.3 < calibration.covered_cells.mean() < 1.0


def test_exact_corners_give_the_camera_and_opencv_agrees_on_others() -> None:
    cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    exact = calibrate_intrinsics(views(5, 0.6, noise=0.0), "wrist", SIZE, free_k3=True)
    assert_close(exact.camera.intrinsics, TRUE.intrinsics, atol=1e-4)
    noisy = views(10, 0.6, 1)
    ours = calibrate_intrinsics(noisy, "wrist", SIZE).camera
    points, pixels = (
        [getattr(view, name).astype(np.float32) for view in noisy] for name in ("points", "pixels")
    )
    _, K, distortion, *_ = cv2.calibrateCamera(points, pixels, SIZE, None, None, flags=cv2.CALIB_FIX_K3)
    theirs = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(distortion)[:4]]
    assert_close((ours.intrinsics[:8] - theirs) / np.array(ours.sigma)[:8], np.zeros(8), atol=0.2)


def test_a_bowed_board_makes_images_disagree(calibration: IntrinsicCalibration) -> None:
    bowed = calibrate_intrinsics(views(8, 0.6, bow=1e-3), "wrist", SIZE)
    assert not calibration.has_excess_scatter
    assert_close(calibration.scatter_ratio, 1.0, atol=0.2)
    assert bowed.has_excess_scatter
    assert bowed.scatter_ratio > 1.5


def test_a_focal_length_in_closed_form() -> None:
    start = initial_camera(views(10, 0.6), "wrist", SIZE)
    assert start.fx == start.fy
    assert_close(start.fx, 1400.0, rtol=0.3)


def test_images_that_do_not_determine_the_camera_are_refused() -> None:
    with refused(MeasurementError, value=2):
        calibrate_intrinsics(views(2, 0.6), "wrist", SIZE)
    with refused(MeasurementError, value="perpendicular ones"):
        calibrate_intrinsics(views(4, 0.0, noise=0.0), "wrist", SIZE)
