"""Rendered images: gray levels of pixels, blur by depth, and corners where the camera projects them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.robot.se3 import rotation_from_zyx
from pisigma.simulation.camera.rendering import Exposure, TrueBoard, render_image

CAMERA = Camera("small", 640, 400, 500.0, 500.0, 319.5, 199.5, -0.1, 0.05, 1e-4, -2e-4, 0.01)
BOARD = Board("board", 4, 5, 0.03)
FLAT = TrueBoard(BOARD)
SHARP = Exposure(blur_in_focus=1e-3, aperture_diameter=0.0, vignetting=0.0, gradient=0.0, noise=0.0)


def pose(distance: float, rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return T_camera_board with the centre of the corners on the camera's axis."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_zyx(torch.tensor(rpy, dtype=torch.float64)).numpy()
    T[:3, 3] = [0, 0, distance] - T[:3, :3] @ BOARD.corners.mean(0)
    return T


def rendered(
    exposure: Exposure, T: np.ndarray, board: TrueBoard = FLAT, camera: Camera = CAMERA
) -> np.ndarray:
    return render_image(camera, board, T, exposure, np.random.default_rng(0)).astype(float)


def test_pixels_have_the_mean_gray_of_their_area():
    """Perpendicular view, 50 px per square, with edges through pixels: 0.3 of each pixel across an edge is black."""
    camera = Camera("straight", 640, 400, 500.0, 500.0, 299.8, 199.8)
    T = np.eye(4)
    T[:3, 3] = [0, 0, 0.3]
    image = rendered(SHARP, T, camera=camera)
    assert image[0, 0] == SHARP.background
    assert image[195, 295] == SHARP.black, "the square beyond corner 0 is black"
    assert image[195, 305] == SHARP.white
    mixed = 0.3 * SHARP.black + 0.7 * SHARP.white
    assert_close(image[180:195, 300], np.full(15, mixed), atol=0.5)
    assert_close(image[200, 270:295], np.full(25, mixed), atol=0.5)


def test_light_falls_off_and_noise_is_added():
    exposure = replace(SHARP, vignetting=0.3, gradient=0.2, noise=3.0)
    image = rendered(exposure, pose(0.4))
    corner = exposure.background * (1 - 0.3) * (1 + 0.1 * np.array([-1, 1]))
    assert_close([image[:9, :9].mean(), image[:9, -9:].mean()], corner, rtol=0.03)
    assert_close(image[:20, :20].std(), 3.0, atol=0.5)


def test_blur_grows_away_from_the_distance_in_focus():
    exposure = replace(SHARP, focus_distance=0.4, aperture_diameter=0.02)
    slopes = [np.abs(np.diff(rendered(exposure, pose(distance)), axis=1)).max() for distance in (0.4, 0.3)]
    assert slopes[0] > 150 > 80 > slopes[1]


@pytest.mark.parametrize("bow", [0.0, 2e-3])
def test_corners_are_detected_where_the_camera_projects_them(bow: float):
    """The board is larger than given and bowed, and the lens has distortion."""
    pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    from pisigma.measurement.camera.detection.detected_board import DetectedBoard
    from pisigma.measurement.camera.detection.detector import detect_checkerboard

    board, T = TrueBoard(BOARD, 1.01, bow), pose(0.3, (0.2, -0.3, 0.4))
    image = rendered(Exposure(focus_distance=0.3), T, board)
    detected = detect_checkerboard(image.astype(np.uint8), BOARD)
    assert isinstance(detected, DetectedBoard)
    projected = CAMERA.project(board.corners @ T[:3, :3].T + T[:3, 3])[0]
    off = detected.pixels - projected
    assert np.sqrt(np.square(off).mean()) < 0.04
    assert_close(off.mean(0), np.zeros(2), atol=0.015)
    flat = CAMERA.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])[0]
    assert np.abs(detected.pixels - flat).max() > 0.5, "the stated board lies elsewhere"


def test_rows_of_a_rolling_shutter_show_the_board_at_their_own_time():
    """A board that moves by 3 mm across the image is sheared: a corner moves by its row's share of the motion."""
    pytest.importorskip("cv2", reason="opencv-python-headless is not installed")
    from pisigma.measurement.camera.detection.detected_board import DetectedBoard
    from pisigma.measurement.camera.detection.detector import detect_checkerboard

    camera, T = Camera("straight", 640, 400, 500.0, 500.0, 319.5, 199.5), pose(0.3)
    shift = np.array([3e-3, 0, 0, 0, 0, 0])
    image = render_image(camera, FLAT, T, Exposure(focus_distance=0.3), np.random.default_rng(0), shift)
    detected = detect_checkerboard(image, BOARD)
    assert isinstance(detected, DetectedBoard)
    still = camera.project(BOARD.corners @ T[:3, :3].T + T[:3, 3])[0]
    moved = 500.0 * 3e-3 / 0.3 * (still[:, 1] / camera.height - 0.5)
    assert np.abs(moved).max() > 0.5
    assert_close(detected.pixels - still, np.stack([moved, 0 * moved], 1), atol=0.05)
