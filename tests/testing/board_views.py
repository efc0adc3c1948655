"""A UR5 with a camera on its flange and a board on a table, and a pointwise check of whether a pose sees it."""

from pathlib import Path

import numpy as np
import torch

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.planning.plan_settings import CameraSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

NEAR, FAR, OBLIQUE, MARGIN = 0.3, 0.7, 45.0, 20.0
"""[m, m, deg, px]"""
CELL = Surroundings.model_validate(
    {
        "floor_mm": -20.0,
        "boxes": [{"name": "table", "center_mm": (450, -100, 0), "size_mm": (300, 300, 98)}],
        "tool": {
            "x_mm": 30.0,
            "y_mm": 20.0,
            "z_mm": 60.0,
            "roll_deg": 6.0,
            "pitch_deg": 1.0,
            "yaw_deg": -2.0,
        },
        "view": {
            "frame": {"x_mm": 420.0, "y_mm": -120.0, "z_mm": 50.0, "yaw_deg": 180.0},
            "near_mm": 1e3 * NEAR,
            "far_mm": 1e3 * FAR,
            "oblique_deg": OBLIQUE,
            "margin_px": MARGIN,
        },
    }
)
CAMERA_YAML = "name: wrist\nwidth: 1920\nheight: 1200\nfx: 1400\nfy: 1400\ncx: 960\ncy: 600\nk1: -0.1\n"
BOARD_YAML = "name: board\nrows: 6\ncolumns: 9\nsquare_mm: 30\n"


def camera_settings(folder: Path, is_fixed: bool = False) -> CameraSettings:
    """Write the files of camera and board."""
    camera, board = folder / "camera.yaml", folder / "board.yaml"
    camera.write_text(CAMERA_YAML)
    board.write_text(BOARD_YAML)
    return CameraSettings(str(camera), str(board), is_fixed)


def arm_before_board(robot: Robot | None = None) -> ArmInSurroundings:
    """Return a robot (default: a UR5) in the cell."""
    return ArmInSurroundings.from_robot(robot or Robot.load("ur5"), CELL)


def sees_board(arm: ArmInSurroundings, settings: CameraSettings, q: np.ndarray, radius: np.ndarray) -> bool:
    """Whether the whole printed sheet is in the image, sharp, near enough to frontal, and not behind a link."""
    camera, board = Camera.load(settings.camera), Board.load(settings.board)
    assert arm.surroundings.view is not None
    frame, target = (
        arm.surroundings.view.T_cell_frame,
        forward_kinematics(arm.robot, torch.from_numpy(q)[None])[0],
    )
    T_board, T_camera = (one.numpy() for one in ((target, frame) if settings.is_fixed else (frame, target)))
    x, y = np.meshgrid(np.linspace(-1.5, board.columns + 0.5, 7), np.linspace(-1.5, board.rows + 0.5, 5))
    points = board.square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1)
    in_cell = points @ T_board[:3, :3].T + T_board[:3, 3]
    seen = (in_cell - T_camera[:3, 3]) @ T_camera[:3, :3]
    pixels = camera.project(seen)[0]
    inside = (pixels >= MARGIN).all() and (pixels <= (camera.width - MARGIN, camera.height - MARGIN)).all()
    sharp = seen[:, 2].min() >= NEAR and seen[:, 2].max() <= FAR
    line = in_cell.mean(0) - T_camera[:3, 3]
    angle = np.degrees(np.arccos(T_board[:3, 2] @ line / np.linalg.norm(line)))
    segments = arm.capsules.segments(torch.from_numpy(q)[None])[0].numpy()
    shares = np.linspace(0.1, 0.8, 20)[:, None, None]
    sight = (T_camera[:3, 3] + shares * (in_cell - T_camera[:3, 3])).reshape(-1, 3)
    free = all(
        _distance(sight, *segments[piece]) > radius[piece] + arm.surroundings.clearance - 1e-3
        for piece in arm.beam_blockers.tolist()
    )
    return bool(inside and sharp and angle <= OBLIQUE and free)


def _distance(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> float:
    along = start + np.linspace(0, 1, 9)[:, None] * (end - start)
    return float(np.linalg.norm(points[:, None] - along, axis=-1).min())
