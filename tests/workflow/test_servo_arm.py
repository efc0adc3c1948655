"""Arms of hobby servos: zeros off by 5 to 17 deg and a repeatability of 0.5 deg are neither faults nor implausible."""

import numpy as np
import torch
from testing.phone_arm import SERVO, phone_rows, servo_arm

import pisigma
from pisigma.robot.kinematics.forward import forward_kinematics


def positions(robot: pisigma.Robot, q: np.ndarray) -> np.ndarray:
    return forward_kinematics(robot, torch.from_numpy(q))[:, :3, 3].numpy()


def test_positions_are_predicted_better_than_the_servos_repeat():
    nominal, true, random = servo_arm(0)
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


def test_images_of_a_phone_are_weighted_by_the_noise_of_the_servos():
    rows, true, later = phone_rows(1, 40)
    settings = pisigma.CalibrationSettings(model="geometric", folds=0)
    identified = pisigma.calibrate("so101", rows, settings).model.identified
    wrong = np.rad2deg(identified.dh - true.dh)[1:4, 0]
    assert np.abs(wrong).max() < 0.35
    error = positions(identified, later.numpy()) - positions(true, later.numpy())
    noisy = later + SERVO * torch.from_numpy(np.random.default_rng(1).normal(size=later.shape))
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
