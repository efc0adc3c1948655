"""Calibrations with several cameras and other sensors, with wrong corners and images, and with transmission errors.

    OMP_NUM_THREADS=1 python benchmarks/camera_setups.py [mixed] [wrong] [bent] [gears] [--draws 10]

Arms, cameras, boards and noise are those of `camera.py`, with fixed intrinsics. The part "mixed" compares a fixed
camera with the board on the flange, two cameras, and a camera with 10 positions of a tracker (0.02 mm) with each of
these instruments alone. The part "wrong" has 5 % of the corners off by 5 px and three images with two swapped joint
values. The part "bent" has a board bowed by 0.3 mm, which is taken as flat or whose flatness is stated. The part
"gears" has joints with two harmonics of 0.015 deg and 150 images, and compares the hybrid with the geometry alone.
Errors are those of the target's position over 400 postures of the whole joint space after the best rigid alignment,
pooled over draws.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from camera import (
    ANGLE,
    BOARD,
    CAMERA,
    CANDIDATES,
    IN_BASE,
    LENGTH,
    NOISE,
    ON_FLANGE,
    POSTURES,
    PRIOR,
    aligned_error,
    views,
)
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.camera.camera_files import IntrinsicsChoice
from pisigma.measurement.camera.image_rows import Images, bent_corners, image_measurements
from pisigma.measurement.dataset import Measurements, join
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, transform_from_xyz_zyx, xyz_zyx_from_transform
from pisigma.simulation.camera.simulated_images import select_far_apart, simulate_images

FIXED_CAMERA = replace(CAMERA, name="fixed", is_fixed=True)
HAND = replace(BOARD, name="hand")
CAMERA_IN_BASE = torch.tensor([0.45, -0.1, 0.9, 0.0, 0.0, np.pi], dtype=torch.float64)
REFLECTOR = np.array([0.05, -0.04, 0.1, 0.0, 0.0, 0.0])
TRACKER_NOISE = 2e-5
WRONG_SHARE, WRONG_BY, SWAPPED = 0.05, 5.0, 3
BOW = np.array([1e-4, 0.0, 1e-4])
"""Heights of the three shapes of the bowed surface [m], which is between planes 0.3 mm apart."""
CHOICES: tuple[IntrinsicsChoice, ...] = ("fixed", "prior", "free")
GEAR = np.deg2rad(0.015)
HARMONICS = (1, 2)
GEAR_IMAGES = 150


class Arm:
    """A random true arm and its instruments."""

    def __init__(self, nominal: Robot, draw: int):
        errors = np.random.default_rng(draw).standard_normal(nominal.dh.shape)
        self.nominal, self.draw = nominal, draw
        self.dh = nominal.dh + errors * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        self.rng = np.random.default_rng(1000 + draw)

    def with_frames(self, in_base: Tensor | None, on_flange: np.ndarray) -> Robot:
        """Return the true arm with a base and a tool."""
        base = None if in_base is None else xyz_zyx_from_transform(invert(transform_from_xyz_zyx(in_base)))
        return self.nominal.with_geometry(
            self.dh, base=None if base is None else base.numpy(), tool=on_flange
        )

    def images(self, q: Tensor, is_fixed: bool = False, wobble: Tensor | float = 0.0) -> Images:
        """Return corners in the images of the camera on the flange, or of the fixed camera."""
        true = self.with_frames(CAMERA_IN_BASE if is_fixed else IN_BASE, ON_FLANGE.numpy())
        generator = torch.Generator().manual_seed(self.draw)
        images = simulate_images(true, q + wobble, CAMERA, BOARD, NOISE, generator, is_fixed)
        return replace(images, q=q)

    def rows(self, q: Tensor, is_fixed: bool = False) -> Measurements:
        """Return the measurements of images."""
        camera, board = (FIXED_CAMERA, HAND) if is_fixed else (CAMERA, BOARD)
        return solved(self.images(q, is_fixed), camera, board)

    def tracked(self, q: Tensor) -> Measurements:
        """Return positions of a reflector on the flange."""
        position = forward_kinematics(self.with_frames(None, REFLECTOR), q)[:, :3, 3]
        noise = TRACKER_NOISE * torch.from_numpy(self.rng.standard_normal((len(q), 3)))
        frame, target = ("tracker",) * len(q), ("reflector",) * len(q)
        return Measurements(q, position + noise, frame=frame, target=target)

    def error(self, estimated: Robot, postures: Tensor, on_flange: np.ndarray) -> float:
        """Return the position error of a target on the flange [m], with the estimated tool of an arm."""
        true = self.with_frames(None, on_flange)
        return aligned_error(*(forward_kinematics(one, postures)[:, :3, 3] for one in (true, estimated)))


def solved(images: Images, camera=CAMERA, board=BOARD) -> Measurements:
    """Return rows of images with fixed intrinsics."""
    return image_measurements(images, camera, board, camera.is_fixed, NOISE.repeatability, "fixed")


def fixed_views(robot: Robot, count: int, rng: np.random.Generator) -> Tensor:
    """Return joint values [rad] at which the fixed camera sees the board on the flange."""
    solver, chosen = closed_form_solver(robot), list[Tensor]()
    T_base_board = transform_from_xyz_zyx(IN_BASE)
    assert solver is not None  # a UR5
    for q in views(robot, 3 * count, rng):
        T_board_camera = invert(T_base_board) @ forward_kinematics(
            robot.with_geometry(tool=ON_FLANGE.numpy()), q
        )
        T = transform_from_xyz_zyx(CAMERA_IN_BASE) @ invert(T_board_camera)
        branches = solver.solve(T @ invert(transform_from_xyz_zyx(ON_FLANGE))).q
        reached = branches[torch.isfinite(branches).all(-1)]
        if len(reached):
            chosen.append(reached[rng.integers(len(reached))])
    return torch.stack(chosen)


def fitted(arm: Arm, rows: Measurements, target: str) -> Robot:
    """Return the calibrated arm with the tool of a target."""
    result = GeometricCalibrator(arm.nominal, prior=PRIOR).fit(rows)
    return result.robot.with_geometry(base=np.zeros(6), tool=result.tools[target])


def mixed(arm: Arm, q: Tensor, q_fixed: Tensor, postures: Tensor) -> Iterator[tuple[str, float]]:
    """Return errors of set-ups with several instruments, and with each of them alone."""
    wrist, fixed, tracker = arm.rows(q), arm.rows(q_fixed, True), arm.tracked(postures[-10:])
    few, few_fixed = arm.rows(q[:25]), arm.rows(q_fixed[:25], True)
    on_flange = ON_FLANGE.numpy()
    for name, rows, target, point in (
        ("camera on the flange, 50 images", [wrist], "wrist", on_flange),
        ("fixed camera, board on the flange, 50 images", [fixed], "hand", on_flange),
        ("camera on the flange, 25 images", [few], "wrist", on_flange),
        ("fixed camera, 25 images", [few_fixed], "hand", on_flange),
        ("both cameras, 25 images each: that on the flange", [few, few_fixed], "wrist", on_flange),
        ("both cameras, 25 images each: the board on the flange", [few, few_fixed], "hand", on_flange),
        ("tracker, 10 positions", [tracker], "reflector", REFLECTOR),
        ("camera, 50 images, and tracker, 10 positions", [wrist, tracker], "wrist", on_flange),
    ):
        yield name, arm.error(fitted(arm, join(rows), target), postures[:-10], point)


def wrong(arm: Arm, q: Tensor, postures: Tensor) -> Iterator[tuple[str, float]]:
    """Return errors with and without wrong corners and images, and whether exactly the wrong images are named."""
    clean, rng = arm.images(q), arm.rng
    faulty = rng.choice(len(q), SWAPPED, replace=False)
    swapped, pixels = q.clone(), []
    for image in faulty:
        joints = rng.choice(q.shape[1], 2, replace=False)
        swapped[image, joints] = swapped[image, joints[::-1].copy()]
    for of_image in clean.pixels:
        direction = rng.uniform(0, 2 * np.pi, len(of_image))
        off = WRONG_BY * np.stack([np.cos(direction), np.sin(direction)], -1)
        pixels.append(of_image + off * (rng.random(len(of_image)) < WRONG_SHARE)[:, None])
    good = np.setdiff1d(np.arange(len(q)), faulty)
    both = solved(replace(clean, q=swapped, pixels=tuple(pixels)))
    for name, rows in (
        ("clean", solved(clean)),
        ("without the three images", solved(clean).select(torch.from_numpy(good))),
        ("5 % wrong corners, three swapped images", both),
    ):
        yield name, arm.error(fitted(arm, rows, "wrist"), postures, ON_FLANGE.numpy())
    outliers = GeometricCalibrator(arm.nominal, prior=PRIOR).fit(both).outliers
    yield (
        "share of the draws in which other images are named",
        float({one.row for one in outliers} != set(faulty)),
    )


def bent(arm: Arm, q: Tensor, postures: Tensor) -> Iterator[tuple[str, float]]:
    """Return errors with a bowed board that is taken as flat, and with its flatness stated."""
    images, pixels = arm.images(q), []
    true = arm.with_frames(IN_BASE, ON_FLANGE.numpy())
    bowed = bent_corners(BOARD, BOW)
    for T, number, flat in zip(
        invert(forward_kinematics(true, q)).numpy(), images.corner_numbers, images.pixels, strict=True
    ):
        here = (CAMERA.project(at[number] @ T[:3, :3].T + T[:3, 3])[0] for at in (bowed, BOARD.corners))
        pixels.append(flat + np.subtract(*here))
    for choice in CHOICES:
        for name, shown, flatness in (
            ("flat board", images, 0.0),
            ("bowed board taken as flat", replace(images, pixels=tuple(pixels)), 0.0),
            ("bowed board with its flatness", replace(images, pixels=tuple(pixels)), 3e-4),
        ):
            board = replace(BOARD, flatness=flatness)
            rows = image_measurements(shown, CAMERA, board, False, NOISE.repeatability, choice)
            error = arm.error(fitted(arm, rows, "wrist"), postures, ON_FLANGE.numpy())
            yield f"intrinsics {choice}, {name}", error


def gears(arm: Arm, q: Tensor, postures: Tensor) -> Iterator[tuple[str, float]]:
    """Return errors of the geometry alone and of the hybrid with transmission errors."""
    phase = torch.from_numpy(arm.rng.uniform(0, 2 * np.pi, (len(HARMONICS), q.shape[1])))

    def wobble(q: Tensor) -> Tensor:
        return sum((GEAR * (m * q + phase[k]).sin() for k, m in enumerate(HARMONICS)), torch.zeros_like(q))

    rows = solved(arm.images(q, wobble=wobble(q)))
    true = arm.with_frames(None, ON_FLANGE.numpy())
    points = forward_kinematics(true, postures + wobble(postures))[:, :3, 3]
    geometry = GeometricCalibrator(arm.nominal, prior=PRIOR)
    alone = forward_kinematics(geometry.fit(rows).robot, postures)[:, :3, 3]
    yield "geometry", aligned_error(points, alone)
    hybrid = HybridCalibrator(geometry).fit(rows)
    yield "hybrid", aligned_error(points, hybrid.predicted_poses(at(rows, postures))[:, :3, 3])


def at(rows: Measurements, q: Tensor) -> Measurements:
    """Return rows with other joint values, in the frame of given rows."""
    return Measurements(
        q, torch.zeros(len(q), 3).to(q), frame=rows.frame[:1] * len(q), target=rows.target[:1] * len(q)
    )


def main(chosen: list[str], draws: int) -> None:
    """Print root mean squares over all draws."""
    nominal, rng = Robot.load("ur5"), np.random.default_rng(0)
    q = select_far_apart(views(nominal, CANDIDATES * 50, rng), 50)
    q_fixed = select_far_apart(fixed_views(nominal, CANDIDATES * 50, rng), 50)
    q_gears = select_far_apart(views(nominal, CANDIDATES * GEAR_IMAGES, rng), GEAR_IMAGES)
    postures = torch.from_numpy(rng.uniform(-np.pi, np.pi, (POSTURES + 10, nominal.dof)))
    parts = {
        "mixed": lambda arm: mixed(arm, q, q_fixed, postures),
        "bent": lambda arm: bent(arm, q, postures),
        "wrong": lambda arm: wrong(arm, q, postures),
        "gears": lambda arm: gears(arm, q_gears, postures),
    }
    for part in chosen or parts:
        errors = defaultdict[str, list[float]](list)
        for draw in range(draws):
            for name, error in parts[part](Arm(nominal, draw)):
                errors[name].append(error)
        print(f"{part}:")
        for name, values in errors.items():
            if name.startswith("share"):
                print(f"  {name}: {np.mean(values):.2f}")
            else:
                print(f"  {name}: {1e3 * np.sqrt(np.mean(np.square(values))):.4f} mm")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("parts", nargs="*", help="Parts to run: mixed, wrong, bent, gears (default: all).")
    parser.add_argument("--draws", type=int, default=10)
    arguments = parser.parse_args()
    main(arguments.parts, arguments.draws)
