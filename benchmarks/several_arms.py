"""Two UR5s whose wrist cameras see one board: relative pose of their bases and its bound, and bumped bases.

    OMP_NUM_THREADS=1 python benchmarks/several_arms.py [bound] [bumped] [--sets 200] [--images 25]

Each arm has errors of 0.3 mm and 0.05 deg in every parameter that the images of a UR5 determine; errors that the base
or the tool absorbs, such as that of the zero of joint 1, are 0, so that the bases have true values. OpenCV projects the
corners of a board of 9 x 6 corners 30 mm apart, seen from 0.3 to 0.7 m, into cameras of 1920 x 1200 px with exact
intrinsics; the noise is 0.3 px and the repeatability of the arms 0.02 mm and 0.01 deg. The bound is computed by
differences of OpenCV's projection, independently of the package's derivatives.

Bumped: the same arms, with 8 new images of each, in 40 cells where nothing moved, and in 20 cells each where the base
of the left arm, that of the right one or the board moved by 0.5 mm and 0.5 mrad.
"""

import argparse
from collections import Counter
from dataclasses import replace

import cv2
import numpy as np
import torch
from camera import BOARD, CAMERA, IN_BASE, ON_FLANGE, views
from hand_eye import CORNER_NOISE, REPEATABILITY, matrix_and_distortion, projected_images

from pisigma.calibration.frames.arm_bases import fit_arm_bases
from pisigma.calibration.frames.shared_objects import ArmPosterior, uncertainty_of
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.estimation.loss import SquaredLoss
from pisigma.lifetime.comparison.moved_bases import RemeasuredArm, find_moved_bases
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.model.frame_model import frames_of_model
from pisigma.model.geometric_model import model_of_calibration
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.row import DH_COLUMNS
from pisigma.robot.se3 import (
    invert,
    pose_error,
    rotation_from_vector,
    transform,
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
)

NOMINAL = Robot.load("ur5")
SIZES = {"theta": np.deg2rad(0.05), "d": 3e-4, "a": 3e-4, "alpha": np.deg2rad(0.05), "beta": np.deg2rad(0.05)}
STEP = 1e-6
ARMS, FEW_IMAGES = ("left", "right"), 8


def board_to_base(number: int) -> torch.Tensor:
    """Return the base of an arm in the frame of the board; the second arm is on its other side."""
    T = invert(transform_from_xyz_zyx(IN_BASE))
    if number == 0:
        return T
    center = torch.from_numpy(BOARD.corners.mean(0))
    half = rotation_from_vector(torch.tensor([0.0, 0.0, np.pi], dtype=torch.float64))
    return transform(half, center - half @ center) @ T


def with_values(free: tuple[str, ...], values: np.ndarray) -> Robot:
    """Return an arm with these values of its free parameters, its base and its tool."""
    dh = NOMINAL.dh.copy()
    for name, value in zip(free, values, strict=False):
        column, joint = name.split("_")
        dh[int(joint) - 1, DH_COLUMNS.index(column)] += value
    return NOMINAL.with_geometry(dh, base=values[-12:-6], tool=values[-6:])


def pixels(robot: Robot, q: torch.Tensor, moved: np.ndarray) -> np.ndarray:
    """Return the corners in every image, after a shift [m] and a rotation [rad] of the tool."""
    move = transform(rotation_from_vector(torch.from_numpy(moved[3:])), torch.from_numpy(moved[:3]))
    T = invert(forward_kinematics(robot, q) @ move).numpy()
    matrix, distortion = matrix_and_distortion(CAMERA)
    return np.stack(
        [
            cv2.projectPoints(BOARD.corners, cv2.Rodrigues(one[:3, :3])[0], one[:3, 3], matrix, distortion)[
                0
            ].ravel()
            for one in T
        ]
    )


def bound_of_base(free: tuple[str, ...], values: np.ndarray, q: torch.Tensor) -> np.ndarray:
    """Return the Cramér-Rao bound of the base of an arm [m and rad]."""
    still = np.zeros(6)

    def slope(at: np.ndarray, of: np.ndarray) -> np.ndarray:
        up, down = (pixels(with_values(free, values + s * at), q, s * of) for s in (STEP, -STEP))
        return (up - down) / (2 * STEP)

    X = np.stack([slope(unit, still) for unit in np.eye(len(values))], -1)
    J = np.stack([slope(np.zeros(len(values)), unit) for unit in np.eye(6)], -1)
    spread = J * ([REPEATABILITY.length] * 3 + [REPEATABILITY.angle] * 3)
    noise = spread @ spread.swapaxes(1, 2) + CORNER_NOISE**2 * np.eye(X.shape[1])
    information = (X.swapaxes(1, 2) @ np.linalg.solve(noise, X)).sum(0)
    return np.linalg.inv(information)[-12:-6, -12:-6]


def bound(parts: list[np.ndarray], bases: list[np.ndarray]) -> np.ndarray:
    """Return the bound of the second base relative to the first one: shifts along and rotations about its axes."""

    def relative(of: np.ndarray) -> torch.Tensor:
        first, second = (transform_from_xyz_zyx(torch.from_numpy(one)) for one in of.reshape(2, 6))
        return invert(first) @ second

    at = np.concatenate(bases)
    J = np.stack(
        [
            pose_error(relative(at + STEP * unit), relative(at - STEP * unit)).numpy() / (2 * STEP)
            for unit in np.eye(12)
        ],
        1,
    )
    of_both = np.zeros((12, 12))
    of_both[:6, :6], of_both[6:, 6:] = parts
    return J @ of_both @ J.T


def measured(
    free: tuple[str, ...], values: np.ndarray, q: torch.Tensor, rng: np.random.Generator
) -> Measurements:
    """Return the images of an arm as measurements."""
    images = projected_images(with_values(free, values), q, rng)
    return image_measurements(images, CAMERA, BOARD, False, REPEATABILITY, "fixed")


def determined_parameters(q: torch.Tensor, base: np.ndarray) -> tuple[str, ...]:
    """Return the parameters of a UR5 that its images determine."""
    drawn = np.concatenate([base, ON_FLANGE.numpy()])
    rows = measured((), drawn, q, np.random.default_rng(0))
    every = GeometricCalibrator(NOMINAL, prior=None, loss=SquaredLoss()).fit(rows).free_parameters
    return tuple(name for name in every if name.split("_")[0] in SIZES)


def drawn_values(free: tuple[str, ...], base: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return random errors of the free parameters, then base and tool."""
    sizes = np.array([SIZES[name.split("_")[0]] for name in free])
    return np.concatenate([sizes * rng.standard_normal(len(free)), base, ON_FLANGE.numpy()])


def compare_with_bound(
    calibrator: GeometricCalibrator, q: list[torch.Tensor], bases: list[np.ndarray], sets: int
) -> None:
    """Print the ratios of RMS errors and of stated standard errors to the bound."""
    free = tuple(calibrator.free)
    errors, stated, bounds, scores = [], [], [], []
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        arms, parts = [], []
        for number, name in enumerate(ARMS):
            values = drawn_values(free, bases[number], rng)
            rows = measured(free, values, q[number], rng)
            arms.append(ArmPosterior(name, uncertainty_of(calibrator.fit(rows))))
            parts.append(bound_of_base(free, values, q[number]))
        T, covariance = fit_arm_bases(arms).relative(0, 1)
        error = pose_error(invert(board_to_base(0)) @ board_to_base(1), T)
        errors.append(error.numpy())
        stated.append(covariance.diagonal().numpy())
        bounds.append(bound(parts, bases).diagonal())
        scores.append(float(error @ torch.linalg.solve(covariance, error)) / 6)
    root = np.sqrt(np.mean(bounds, 0))
    print(f"{sets} sets of 2 x {len(q[0])} images, {len(free)} free parameters of each arm")
    print("                          x        y        z  about x  about y  about z")
    for what, figures in (
        ("bound [um, urad]", root * 1e6),
        ("RMS error / bound", np.sqrt(np.square(errors).mean(0)) / root),
        ("stated / bound", np.sqrt(np.mean(stated, 0)) / root),
    ):
        print(f"{what:18}" + "".join(f"{value:9.3f}" for value in figures))
    print(f"mean squared error in units of the stated covariance, per value: {np.mean(scores):.3f}")


def find_bumped(
    calibrator: GeometricCalibrator, q: list[torch.Tensor], bases: list[np.ndarray], still: int
) -> None:
    """Print how often nothing is named if nothing moved, and otherwise the body that moved."""
    free, named, counts = tuple(calibrator.free), Counter[tuple[str, str]](), Counter[str]()
    direction = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64)
    bump = transform(rotation_from_vector(5e-4 * direction.flip(0)), 5e-4 * direction)
    later = [views(NOMINAL, FEW_IMAGES, np.random.default_rng(1 + number)) for number in range(2)]
    for seed in range(still):
        rng = np.random.default_rng(1000 + seed)
        values = [drawn_values(free, base, rng) for base in bases]
        rows = [measured(free, values[k], q[k], rng) for k in range(2)]
        fits = [calibrator.fit(one) for one in rows]
        known = [ArmPosterior(name, uncertainty_of(fit)) for name, fit in zip(ARMS, fits, strict=True)]
        models = [
            replace(model_of_calibration(arm.name, NOMINAL, fit, one), uncertainty=arm.uncertainty)
            for arm, fit, one in zip(known, fits, rows, strict=True)
        ]
        T = fit_arm_bases(known).T_first_base
        for body in ("nothing",) if seed % 2 else ("nothing", *ARMS, "board"):
            now = []
            for number, arm in enumerate(ARMS):
                motion = {arm: bump, "board": invert(bump)}.get(body, torch.eye(4, dtype=torch.float64))
                base = xyz_zyx_from_transform(motion @ board_to_base(number)).numpy()
                there = np.concatenate([values[number][:-12], base, values[number][-6:]])
                images = measured(free, there, later[number], rng)
                now.append(frames_of_model(models[number], images, "base"))
            found = find_moved_bases([RemeasuredArm(*one) for one in zip(known, T, now, strict=True)])
            text = " or ".join(one.name for one in found.likely_bodies) or "nothing"
            named[body, text if found.is_one_body else f"more than {text}"] += 1
            counts[body] += 1
    for (body, text), count in sorted(named.items()):
        print(f"{body} moved: named {text} in {count} of {counts[body]}")


def main() -> None:
    """Run the comparisons, all or those that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", type=int, default=200)
    parser.add_argument("--images", type=int, default=25)
    parser.add_argument("--still", type=int, default=40)
    parser.add_argument("parts", nargs="*", default=("bound", "bumped"))
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    q = [views(NOMINAL, arguments.images, rng) for _ in range(2)]
    bases = [xyz_zyx_from_transform(board_to_base(number)).numpy() for number in range(2)]
    free = determined_parameters(q[0], bases[0])
    calibrator = GeometricCalibrator(NOMINAL, free=free, prior=None, loss=SquaredLoss())
    if "bound" in arguments.parts:
        compare_with_bound(calibrator, q, bases, arguments.sets)
    if "bumped" in arguments.parts:
        find_bumped(calibrator, q, bases, arguments.still)


if __name__ == "__main__":
    main()
