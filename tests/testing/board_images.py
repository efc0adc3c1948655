"""Images of boards, drawn by OpenCV as polygons that the camera projects."""

import numpy as np
import pytest
import torch

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.pattern import printed_pattern
from pisigma.robot.se3 import rotation_from_zyx

cv2 = pytest.importorskip("cv2", reason="opencv-python-headless is not installed")

CAMERA = Camera("small", 640, 400, 500.0, 500.0, 320.0, 200.0)
FINER = 8
"""Oversampling along each axis, for drawing polygons."""


def view(board: Board, distance: float, rpy: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return R_camera_board and t [m] with the board's centre on the camera's axis; 0, 0, 0 is a frontal view."""
    R = rotation_from_zyx(torch.tensor(rpy, dtype=torch.float64)).numpy()
    return R, np.array([0.0, 0.0, distance]) - R @ (board.corners.max(0) / 2)


def draw_board(
    board: Board,
    R: np.ndarray,
    t: np.ndarray,
    camera: Camera = CAMERA,
    blur: float = 0.8,
    noise: float = 1.0,
) -> np.ndarray:
    """Return a grey image of a white sheet with a board on a grey background."""
    pattern = printed_pattern(board)
    image = np.full((FINER * camera.height, FINER * camera.width), 120, dtype=np.uint8)
    for rectangle, gray in (
        (pattern.sheet_rectangle, 210),
        *((black, 40) for black in pattern.black_rectangles),
    ):
        left, top, right, bottom = rectangle
        ends = np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]])
        pixels = (camera.project(ends @ R.T + t)[0] + 0.5) * FINER - 0.5
        cv2.fillConvexPoly(image, np.rint(pixels * 1024).astype(np.int32), gray, shift=10)
    small = cv2.resize(image.astype(np.float32), (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), blur)
    small += noise * np.random.default_rng(0).standard_normal(small.shape)
    return np.clip(np.rint(small), 0, 255).astype(np.uint8)
