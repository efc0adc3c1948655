"""Simulated images of a board: where its corners appear to the camera of a true robot."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import Images
from pisigma.robot.description import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, rotation_from_vector, transform
from pisigma.simulation.camera.true_board import TrueBoard


@dataclass(frozen=True)
class ImageNoise:
    """What is uncertain in every image.

    Attributes:
        corner: standard deviation of u and v of every corner [px].
        repeatability: of the robot's pose, the same for all corners of an image.
    """

    corner: float = 0.3
    repeatability: Repeatability = field(default_factory=Repeatability)


def draw_board_poses(
    robot: Robot,
    q: Float64[Tensor, "images dof"],
    repeatability: Repeatability,
    generator: torch.Generator,
    is_fixed: bool = False,
) -> Float64[Tensor, "images 4 4"]:
    """Return T_camera_board of images that a true robot stops for.

    Args:
        robot: true arm; base and tool lead from the board to the base and from the flange to the camera (of a fixed
            camera: from the camera to the base, and from the flange to the board).
        q: joint values of the images [rad or m].
        repeatability: of the robot.
        generator: of the poses' errors.
        is_fixed: whether the camera is fixed and the board on the flange.
    """
    T = forward_kinematics(robot, q)
    turn, shift = (torch.randn((len(q), 3), generator=generator, dtype=torch.float64) for _ in range(2))
    turned = rotation_from_vector(repeatability.angle * turn) @ T[:, :3, :3]
    T = transform(turned, T[:, :3, 3] + repeatability.length * shift)
    return T if is_fixed else invert(T)


def project_corners(
    camera: Camera, board: Board | TrueBoard, T_camera_board: Float64[Tensor, "images 4 4"]
) -> tuple[Float64[np.ndarray, "images corners 2"], Bool[np.ndarray, "images corners"]]:
    """Return where corners appear [px], and which of them are in front of the camera and inside of its images."""
    corners = torch.from_numpy(board.corners)
    points = (corners @ T_camera_board[:, :3, :3].mT + T_camera_board[:, None, :3, 3]).numpy()
    pixels = camera.project(points)[0]
    inside = (points[..., 2] > 0) & (pixels >= 0).all(-1) & (pixels < (camera.width, camera.height)).all(-1)
    return pixels, inside


def simulate_images(
    robot: Robot,
    q: Float64[Tensor, "images dof"],
    camera: Camera,
    board: Board | TrueBoard,
    noise: ImageNoise,
    generator: torch.Generator,
    is_fixed: bool = False,
) -> Images:
    """Project the corners of a board into the images of a camera.

    Args:
        robot: true arm; see `draw_board_poses`.
        q: joint values of the images [rad or m].
        camera: that takes them.
        board: that they show.
        noise: of corners and robot.
        generator: of the noise.
        is_fixed: whether the camera is fixed and the board on the flange.

    Returns:
        The corners that are in front of the camera and inside of its images.
    """
    T_camera_board = draw_board_poses(robot, q, noise.repeatability, generator, is_fixed)
    pixels, inside = project_corners(camera, board, T_camera_board)
    pixels += noise.corner * torch.randn(pixels.shape, generator=generator, dtype=torch.float64).numpy()
    return images_of(
        q, [np.flatnonzero(row) for row in inside], [at[row] for at, row in zip(pixels, inside, strict=True)]
    )


def images_of(
    q: Float64[Tensor, "images dof"], corners: Sequence[np.ndarray], pixels: Sequence[np.ndarray]
) -> Images:
    """Gather simulated corners, image by image.

    Args:
        q: joint values of every image [rad or m].
        corners: numbers of the corners that every image shows.
        pixels: where it shows them [px].
    """
    names = tuple(f"{number:04d}" for number in range(len(q)))
    return Images("simulated images", names, q, (0,) * len(q), tuple(corners), tuple(pixels))
