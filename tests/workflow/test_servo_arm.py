"""Arms of hobby servos: zeros off by 5 to 17 deg and a repeatability of 0.5 deg are neither faults nor implausible."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import pisigma
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import transform_from_xyzrpy, xyzrpy_from_transform
from pisigma.simulation.camera.simulated_images import ImageNoise, project_corners, simulate_images

SERVO = np.deg2rad(0.5)


def servo_arm(seed: int) -> tuple[pisigma.Robot, pisigma.Robot, np.random.Generator]:
    """An SO-101 as described, and as built: zeros off by 5 to 17 deg, links by 1 mm, axes by 2.5 mrad."""
    random, nominal = np.random.default_rng(seed), pisigma.Robot.load("so101")
    dh = nominal.dh.copy()
    dh[:, 0] += np.deg2rad(random.uniform(5, 17, 5)) * random.choice([-1, 1], 5)
    dh[:, 1:3] += random.normal(0, 1e-3, (5, 2))
    dh[:, 3:] += random.normal(0, 2.5e-3, (5, 2))
    return nominal, nominal.with_geometry(dh, base=nominal.base + random.uniform(-0.3, 0.3, 6)), random


def positions(robot: pisigma.Robot, q: np.ndarray) -> np.ndarray:
    return forward_kinematics(robot, torch.from_numpy(q))[:, :3, 3].numpy()


@pytest.mark.parametrize("seed", [0, 1])
def test_positions_are_predicted_better_than_the_servos_repeat(seed):
    nominal, true, random = servo_arm(seed)
    low, high = np.clip(nominal.limits, -1.6, 1.6).T
    q, later = random.uniform(low, high, (40, 5)), random.uniform(low, high, (200, 5))
    measured = positions(true, q + SERVO * random.normal(size=q.shape)) + 1e-3 * random.normal(size=(40, 3))
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    calibration = pisigma.calibrate(
        nominal, pisigma.Measurements(torch.from_numpy(q), torch.from_numpy(measured)), settings
    )
    assert not calibration.to_json()["diagnostics"]
    error = positions(calibration.model.identified, later) - positions(true, later)
    noise = positions(true, later + SERVO * random.normal(size=later.shape)) - positions(true, later)
    assert np.square(error).sum(1).mean() < np.square(noise).sum(1).mean()


PHONE = Camera("phone", 1920, 1440, 1420.0, 1420.0, 960.0, 720.0, is_fixed=True)
BOARD = Board("board", 5, 7, 0.014)
FROM_PHONE = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0.2], [-1, 0, 0, 0.8], [0, 0, 0, 1]])
"""T_camera_base: the phone looks at the arm from 0.8 m in front of it, 0.2 m above the table."""


def images(seed: int, count: int) -> tuple[pisigma.Measurements, pisigma.Robot, torch.Tensor]:
    """Rows of images of a board in the gripper, the arm as built, and joint values of later images."""
    nominal, true, random = servo_arm(seed)
    T_base = torch.from_numpy(FROM_PHONE) @ transform_from_xyzrpy(torch.tensor(nominal.base))
    T_tool = (
        transform_from_xyzrpy(torch.tensor(nominal.tool))
        @ torch.diag(torch.tensor([1.0, -1, -1, 1])).double()
    )
    true = true.with_geometry(
        true.dh, base=xyzrpy_from_transform(T_base).numpy(), tool=xyzrpy_from_transform(T_tool).numpy()
    )
    q = torch.from_numpy(random.uniform(*np.clip(nominal.limits, -1.5, 1.5).T, (20 * count, 5)))
    T = forward_kinematics(true, q)
    faces = T[:, 2, 2] > 0.7
    q = q[faces & torch.from_numpy(project_corners(PHONE, BOARD, T)[1].all(1))]
    actual = q[:count] + SERVO * torch.from_numpy(random.normal(size=(count, 5)))
    noise, generator = ImageNoise(0.1, Repeatability(0.0, 0.0)), torch.Generator().manual_seed(seed)
    seen = replace(simulate_images(true, actual, PHONE, BOARD, noise, generator, True), q=q[:count])
    return image_measurements(seen, PHONE, BOARD, True, Repeatability(), "free"), true, q[count:]


@pytest.mark.parametrize("seed", [0, 1])
def test_images_of_a_phone_are_weighted_by_the_noise_of_the_servos(seed):
    rows, true, later = images(seed, 40)
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    identified = pisigma.calibrate("so101", rows, settings).model.identified
    wrong = np.rad2deg(identified.dh - true.dh)[1:4, 0]
    assert np.abs(wrong).max() < 0.35
    error = positions(identified, later.numpy()) - positions(true, later.numpy())
    noisy = later + SERVO * torch.from_numpy(np.random.default_rng(seed).normal(size=later.shape))
    noise = positions(true, noisy.numpy()) - positions(true, later.numpy())
    assert np.square(error).sum() < 0.25 * np.square(noise).sum()


def test_lengths_between_touched_points_calibrate_without_held_out_rows():
    """The zeros of this arm make lengths of the nominal arm wrong by more than those of other classes can be."""
    nominal, true, random = servo_arm(4)
    low, high = np.clip(nominal.limits, -1.6, 1.6).T
    q, later = random.uniform(low, high, (80, 5)), random.uniform(low, high, (200, 5))
    points = positions(true, q)
    length = torch.from_numpy(np.linalg.norm(points[::2] - points[1::2], axis=1)).repeat_interleave(2)
    logged = torch.from_numpy(q + SERVO * random.normal(size=q.shape))
    pairs = tuple(f"pair {number}" for number in range(40) for _ in range(2))
    rows = pisigma.Measurements(logged, distance=length, pair=pairs)
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    calibration = pisigma.calibrate(nominal, rows, settings)
    apart = [np.linalg.norm(np.diff(positions(one, later), axis=0), axis=1) for one in (nominal, true)]
    found = np.linalg.norm(np.diff(positions(calibration.model.identified, later), axis=0), axis=1)
    assert np.square(found - apart[1]).mean() < 0.1 * np.square(apart[0] - apart[1]).mean()
    assert calibration.summary.predicted_rms_mm > 0
