"""Compare calibrations of a UR5 from rendered images with calibrations from ideal corners.

    OMP_NUM_THREADS=1 python benchmarks/camera_pixels.py [--draws 5] [--images 40]

Arms, camera, board and repeatability are those of `camera.py`. Every image is rendered pixel by pixel (with lens
distortion, blur, defocus, uneven light and noise), its corners are detected, and the arm is calibrated with them.
For comparison the arm is calibrated with the ideal corners of the same images: with normally distributed noise of the
size of the detection errors, with the noise of `camera.py`, and without noise. Intrinsics are fixed.
Errors are those of the camera's position over 400 postures of the whole joint space after the best rigid alignment,
pooled over draws.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import torch
from camera import ANGLE, BOARD, CAMERA, LENGTH, NOISE, ON_FLANGE, POSTURES, PRIOR, aligned_error, positions

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.camera.detection.detected_board import DetectedBoard
from pisigma.measurement.camera.detection.detector import detect_checkerboard
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.robot import Robot
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.simulation.camera.rendering import Exposure, TrueBoard, render_image
from pisigma.simulation.camera.simulated_images import (
    RandomViews,
    images_of,
    noisy_board_poses,
    project_corners,
)

LENS = replace(CAMERA, k1=-0.1, k2=0.05, p1=1e-4, p2=-2e-4)
IN_BASE = torch.tensor([0.42, 0.08, 0.05, 0.0, 0.0, np.pi], dtype=torch.float64)
"""Pose of the board, which lies in front of the arm with its print up, so that its z axis points down."""


def main(draws: int, count: int) -> None:
    """Print root mean squares over all draws."""
    nominal = Robot.load("ur5")
    base = xyz_zyx_from_transform(invert(transform_from_xyz_zyx(IN_BASE))).numpy()
    aimed = nominal.with_geometry(nominal.dh, base=base, tool=ON_FLANGE.numpy())
    q = RandomViews(count=count, seed=0).joints(aimed, LENS, BOARD)
    everywhere = torch.from_numpy(np.random.default_rng(0).uniform(-np.pi, np.pi, (POSTURES, nominal.dof)))
    squares = dict.fromkeys(("detected", "exact", "as_noisy", "usual"), 0.0)
    off, seconds, left_out = list[np.ndarray](), 0.0, 0
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        errors = rng.standard_normal(nominal.dh.shape) * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        true = nominal.with_geometry(nominal.dh + errors, base=base, tool=ON_FLANGE.numpy())
        poses = noisy_board_poses(true, q, NOISE.repeatability, torch.Generator().manual_seed(draw))
        ideal, inside = project_corners(LENS, BOARD, poses)
        detected, exact = list[np.ndarray](), list[np.ndarray]()
        whole = list[int]()
        for number in range(count):
            started = time.perf_counter()
            image = render_image(LENS, TrueBoard(BOARD), poses[number].numpy(), Exposure(), rng)
            seconds += time.perf_counter() - started
            board = detect_checkerboard(image, BOARD)
            if isinstance(board, DetectedBoard) and inside[number].all():
                whole.append(number)
                detected.append(board.pixels)
                exact.append(ideal[number])
        left_out += count - len(whole)
        off.append(np.concatenate(detected) - np.concatenate(exact))
        normal = rng.standard_normal((len(whole), len(BOARD.corners), 2))
        corners = {
            "detected": detected,
            "exact": exact,
            "as_noisy": list(exact + np.sqrt(np.square(off[-1]).mean()) * normal),
            "usual": list(exact + NOISE.corner * normal),
        }
        numbers = [np.arange(len(BOARD.corners))] * len(whole)
        points = positions(true, everywhere)
        for what, pixels in corners.items():
            images = images_of(q[whole], numbers, pixels)
            rows = image_measurements(images, LENS, BOARD, False, NOISE.repeatability, "fixed")
            robot = GeometricCalibrator(nominal, prior=PRIOR).fit(rows).robot
            squares[what] += aligned_error(points, positions(robot, everywhere)) ** 2
    of = {what: 1e3 * (square / draws) ** 0.5 for what, square in squares.items()}
    print(f"{count} images of 1920 x 1200 px, {draws} draws; {seconds / draws / count:.2f} s to render one")
    print(
        f"corners: {np.sqrt(np.square(np.concatenate(off)).mean()):.4f} px RMS; {left_out} boards not detected"
    )
    print(f"workspace: {of['detected']:.4f} mm from pixels")
    for what, name in (
        ("as_noisy", "as large a normal noise"),
        ("usual", f"a noise of {NOISE.corner} px"),
        ("exact", "no noise"),
    ):
        print(f"ideal corners with {name}: {of[what]:.4f} mm (ratio {of['detected'] / of[what]:.2f})")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--images", type=int, default=40)
    arguments = parser.parse_args()
    main(arguments.draws, arguments.images)
