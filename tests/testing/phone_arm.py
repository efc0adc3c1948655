"""An SO-101 as built by a hobbyist, and a phone beside it that sees a board in its gripper."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.simulation.camera.rendering import Exposure, TrueBoard, render_image
from pisigma.simulation.camera.simulated_images import (
    ImageNoise,
    project_corners,
    select_far_apart,
    simulate_images,
)

SERVO = np.deg2rad(0.5)
PHONE = Camera("phone", 1280, 960, 950.0, 950.0, 642.0, 475.0, 0.05, -0.1, is_fixed=True)
BOARD = Board("board", 4, 6, 0.018, "charuco", 0.013, "4x4_50")
FROM_PHONE = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0.2], [-1, 0, 0, 0.8], [0, 0, 0, 1]])
"""T_camera_base: the phone looks at the arm from 0.8 m in front of it, 0.2 m above the table."""
_NONE = Repeatability(0.0, 0.0)
RATE, REST, MOVE = 20, 12, 4
"""Frames of a video per second, at every pose, and between two poses."""


def servo_arm(seed: int) -> tuple[Robot, Robot, np.random.Generator]:
    """Return an SO-101 as described, and as built: zeros off by 5 to 17 deg, links by 1 mm, axes by 2.5 mrad."""
    random, nominal = np.random.default_rng(seed), Robot.load("so101")
    dh = nominal.dh.copy()
    dh[:, 0] += np.deg2rad(random.uniform(5, 17, 5)) * random.choice([-1, 1], 5)
    dh[:, 1:3] += random.normal(0, 1e-3, (5, 2))
    dh[:, 3:] += random.normal(0, 2.5e-3, (5, 2))
    return nominal, nominal.with_geometry(dh, base=nominal.base + random.uniform(-0.3, 0.3, 6)), random


def arm_before_phone(seed: int) -> tuple[Robot, torch.Tensor, np.random.Generator]:
    """Return an arm as built, with the phone as frame and the board as target, and 500 joint values in view [rad]."""
    nominal, true, random = servo_arm(seed)
    T_base = torch.from_numpy(FROM_PHONE) @ transform_from_xyz_zyx(torch.tensor(nominal.base))
    facing = torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    T_tool = transform_from_xyz_zyx(torch.tensor(nominal.tool)) @ facing
    true = true.with_geometry(
        true.dh, base=xyz_zyx_from_transform(T_base).numpy(), tool=xyz_zyx_from_transform(T_tool).numpy()
    )
    q = torch.from_numpy(random.uniform(*np.clip(nominal.limits, -1.5, 1.5).T, (20_000, 5)))
    T = forward_kinematics(true, q)
    seen = torch.from_numpy(project_corners(PHONE, BOARD, T)[1].all(1))
    return true, q[(T[:, 2, 2] > 0.7) & seen][:500], random


def phone_rows(seed: int, count: int) -> tuple[Measurements, Robot, torch.Tensor]:
    """Return rows of images with servo noise, the arm as built, and joint values of later images [rad]."""
    true, q, random = arm_before_phone(seed)
    return rows_of_phone(true, q[:count], random, seed), true, q[count:]


def rows_of_phone(
    true: Robot,
    q: torch.Tensor,
    random: np.random.Generator,
    seed: int,
    servo: float = SERVO,
    shared: Repeatability = _NONE,
) -> Measurements:
    """Return rows of images of an arm at commanded joint values [rad], with noise of servos [rad] and of poses."""
    actual = q + servo * torch.from_numpy(random.normal(size=q.shape))
    noise, generator = ImageNoise(0.1, shared), torch.Generator().manual_seed(seed)
    seen = replace(simulate_images(true, actual, PHONE, BOARD, noise, generator, True), q=q)
    return image_measurements(seen, PHONE, BOARD, True, Repeatability(), "free")


def write_video(path: Path, count: int) -> None:
    """Write a video of the arm that rests at poses far apart, and joints.csv with the numbers of the stops."""
    import cv2

    true, q, random = arm_before_phone(0)
    q = select_far_apart(q, count)
    actual = q + SERVO * torch.from_numpy(random.normal(size=(count, 5)))
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), RATE, (PHONE.width, PHONE.height))
    lines = [",".join(("image", *(f"q{joint}_deg" for joint in range(1, 6))))]
    for number, at in enumerate(actual):
        steps = torch.linspace(0, 1, MOVE + 1, dtype=torch.float64)[1:, None]
        moving = at + (actual[number + 1] - at) * steps if number + 1 < count else at[None][:0]
        poses = forward_kinematics(true, torch.cat([at[None], moving])).numpy()
        for frame, T in enumerate(poses):
            image = render_image(
                PHONE, TrueBoard(BOARD), T, Exposure(blur_in_focus=1.0, focus_distance=0.5), random
            )
            for _ in range(1 if frame else REST):
                video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        shown = ",".join(f"{value:.3f}" for value in torch.rad2deg(q[number]).tolist())
        lines.append(f"{number + 1},{shown}")
    video.release()
    path.with_name("joints.csv").write_text("\n".join(lines) + "\n")
