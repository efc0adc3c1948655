"""A UR5 with a camera on its flange, or next to it, and a board that the camera sees."""

import functools
from dataclasses import dataclass

import numpy as np
import torch
from testing.models import no_type_checker
from torch import Tensor

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.image_rows import Images
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.se3 import (
    invert,
    rotation_from_zyx,
    transform,
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
)
from pisigma.simulation.camera.simulated_images import ImageNoise, simulate_images

CAMERA = Camera("wrist", 1920, 1200, 1400.0, 1400.0, 960.0, 600.0, -0.1, 0.05, 1e-4, -2e-4, 0.01)
BOARD = Board("board", 6, 9, 0.03)
BOARD_IN_BASE = np.array([0.42, -0.12, 0.05, 0.0, 0.0, 0.0])
CAMERA_IN_BASE = np.array([0.45, -0.1, 0.9, 0.0, 0.0, np.pi])
"""Pose of a fixed camera, which looks down."""
ON_FLANGE = np.array([0.03, 0.02, 0.06, 0.1, 0.02, -0.03])
"""Pose of the camera, or of the board, on the flange."""
NOISE = ImageNoise()
LENGTH, ANGLE = 1e-3, np.deg2rad(0.3)
"""Standard deviations of the arm's errors [m, rad]."""


@dataclass(frozen=True, eq=False)
class CameraCell:
    """The nominal robot, the true one with base and tool, and its images."""

    nominal: Robot
    true: Robot
    images: Images
    is_fixed: bool


@functools.cache
def camera_cell(
    count: int,
    seed: int = 0,
    noise: ImageNoise = NOISE,
    is_fixed: bool = False,
    length: float = LENGTH,
    angle: float = ANGLE,
) -> CameraCell:
    """Return images of the whole board from 0.3 to 0.7 m, tilted by at most 40 deg, with all branches of the arm."""
    with no_type_checker():
        nominal = Robot.load("ur5")
        first = CAMERA_IN_BASE if is_fixed else BOARD_IN_BASE
        rng = np.random.default_rng(seed)
        errors = rng.standard_normal(nominal.dh.shape) * [angle, length, length, angle, angle]
        base = xyz_zyx_from_transform(invert(_transform(first))).numpy()
        true = nominal.with_geometry(nominal.dh + errors, base=base, tool=ON_FLANGE)
        q = _joints_of_views(nominal, count, rng, is_fixed)
        generator = torch.Generator().manual_seed(seed)
        images = simulate_images(true, q, CAMERA, BOARD, noise, generator, is_fixed)
        return CameraCell(nominal, true, images, is_fixed)


def _joints_of_views(robot: Robot, count: int, rng: np.random.Generator, is_fixed: bool) -> Tensor:
    """Return joint values [rad] at which the nominal robot shows the board to the camera."""
    solver, chosen = closed_form_solver(robot), list[Tensor]()
    assert solver is not None
    while len(chosen) < count:
        tilt, direction, roll = rng.uniform((0, 0, 0), (np.deg2rad(40), 2 * np.pi, 2 * np.pi))
        angles = torch.tensor([[direction, tilt, np.pi], [roll, 0, 0]], dtype=torch.float64)
        around, about_view = rotation_from_zyx(angles)
        position = torch.from_numpy(BOARD.corners.mean(0)) - rng.uniform(0.3, 0.7) * around[:, 2]
        view = transform(around @ about_view, position)
        T = _transform(CAMERA_IN_BASE) @ invert(view) if is_fixed else _transform(BOARD_IN_BASE) @ view
        branches = solver.solve(T @ invert(_transform(ON_FLANGE))).q
        reached = branches[torch.isfinite(branches).all(-1)]
        if len(reached):
            chosen.append(reached[rng.integers(len(reached))])
    return torch.stack(chosen)


def corner_lines(images: Images) -> list[str]:
    """Return the lines of a file of corners, the header first."""
    dof = images.q.shape[1]
    lines = ["image,corner,u_px,v_px," + ",".join(f"q{joint + 1}_deg" for joint in range(dof))]
    for name, q, corners, pixels in zip(
        images.names, images.q, images.corner_numbers, images.pixels, strict=True
    ):
        joints = ",".join(f"{value:.10f}" for value in np.rad2deg(q.numpy()))
        lines += [
            f"{name},{corner},{u:.6f},{v:.6f},{joints}"
            for corner, (u, v) in zip(corners, pixels, strict=True)
        ]
    return lines


def aligned_error(true: Tensor, estimated: Tensor) -> float:
    """Compute the RMS distance of points `(points, 3)` [m] after the best rigid alignment (Kabsch 1976)."""
    A, B = (points - points.mean(0) for points in (true, estimated))
    U, _, Vh = torch.linalg.svd(B.T @ A)
    U[:, 2] *= torch.sign(torch.det(U @ Vh))
    return float((A - B @ U @ Vh).norm(dim=1).square().mean().sqrt())


def _transform(xyz_zyx: np.ndarray) -> Tensor:
    return transform_from_xyz_zyx(torch.from_numpy(xyz_zyx))
