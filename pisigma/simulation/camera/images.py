"""Simulated images of a board: where its corners appear to the camera of a true robot."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.camera.board import Board
from pisigma.camera.camera import Camera
from pisigma.camera.image_rows import Images, Repeatability
from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot.description import Robot
from pisigma.se3 import invert, rotation_from_vector, transform


@dataclass(frozen=True)
class ImageNoise:
    """What is uncertain in every image.

    Attributes:
        corner: standard deviation of u and v of every corner [px].
        repeatability: of the robot's pose, the same for all corners of an image.
    """

    corner: float = 0.3
    repeatability: Repeatability = field(default_factory=Repeatability)


def simulate_images(
    robot: Robot,
    q: Float64[Tensor, "images dof"],
    camera: Camera,
    board: Board,
    noise: ImageNoise,
    generator: torch.Generator,
    is_fixed: bool = False,
) -> Images:
    """Project the corners of a board into the images of a camera.

    Args:
        robot: true arm; base and tool lead from the board to the base and from the flange to the camera (of a fixed
            camera: from the camera to the base, and from the flange to the board).
        q: joint values of the images [rad or m].
        camera: that takes them.
        board: that they show.
        noise: of corners and robot.
        generator: of the noise.
        is_fixed: whether the camera is fixed and the board on the flange.

    Returns:
        The corners that are in front of the camera and inside of its images.
    """

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    T = forward_kinematics(robot, q)
    turned = rotation_from_vector(noise.repeatability.angle * draw(len(q), 3)) @ T[:, :3, :3]
    T = transform(turned, T[:, :3, 3] + noise.repeatability.length * draw(len(q), 3))
    T_camera_board = T if is_fixed else invert(T)
    corners = torch.from_numpy(board.corners)
    points = (corners @ T_camera_board[:, :3, :3].mT + T_camera_board[:, None, :3, 3]).numpy()
    pixels = camera.project(points)[0] + noise.corner * draw(*points.shape[:2], 2).numpy()
    inside = (points[..., 2] > 0) & (pixels >= 0).all(-1) & (pixels < (camera.width, camera.height)).all(-1)
    return Images(
        source="simulated images",
        names=tuple(f"{number:04d}" for number in range(len(q))),
        q=q,
        lines=(0,) * len(q),
        corners=tuple(np.flatnonzero(row) for row in inside),
        pixels=tuple(of_image[row] for of_image, row in zip(pixels, inside, strict=True)),
    )
