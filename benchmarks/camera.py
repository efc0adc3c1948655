"""A UR5 calibrated by a camera on its flange: true error over the workspace, with the Cramér-Rao bound beside it.

    OMP_NUM_THREADS=1 python benchmarks/camera.py [--draws 20] [--images 50]

True arms have errors of 1 mm and 0.3 deg on every parameter. The camera (1920 x 1200 px, f = 1400 px, intrinsics taken
as they are) looks from 0.3 to 0.7 m, up to 40 deg oblique, at a board of 9 x 6 corners 30 mm apart; corners have
0.3 px, the robot repeats to 0.02 mm and 0.01 deg. Errors are those of the camera centre's position after the best rigid
alignment, over other views of the board (region) and over 400 postures of the whole joint space (workspace), pooled
over draws.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from pisigma.camera.board import Board
from pisigma.camera.camera import Camera
from pisigma.camera.image_rows import Images, Repeatability, image_measurements
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.identification.problem.parameters import Prior
from pisigma.identification.problem.problem import MotionMemory
from pisigma.kinematics.closed_form.registry import closed_form_solver
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.se3 import (
    invert,
    rotation_from_rpy,
    skew,
    transform,
    transform_from_xyzrpy,
    xyzrpy_from_transform,
)
from pisigma.simulation.camera.images import ImageNoise, simulate_images

LENGTH, ANGLE = 1e-3, np.deg2rad(0.3)
CAMERA = Camera("wrist", 1920, 1200, 1400.0, 1400.0, 960.0, 600.0)
BOARD = Board("board", 6, 9, 0.03)
ON_FLANGE = torch.tensor([0.03, 0.02, 0.06, 0.1, 0.02, -0.03], dtype=torch.float64)
IN_BASE = torch.tensor([0.42, -0.12, 0.05, 0.0, 0.0, 0.0], dtype=torch.float64)
NOISE = ImageNoise()
CANDIDATES, POSTURES, VIEWS = 8, 400, 200
PRIOR = Prior(theta=ANGLE, d=LENGTH, a=LENGTH, alpha=ANGLE, beta=ANGLE)


def views(robot: Robot, count: int, rng: np.random.Generator) -> Tensor:
    """Joint values [rad] of random views of the board, each by a random branch of the arm."""
    solver, chosen = closed_form_solver(robot), list[Tensor]()
    assert solver is not None
    while len(chosen) < count:
        tilt, direction, roll = rng.uniform((0, 0, 0), (np.deg2rad(40), 2 * np.pi, 2 * np.pi))
        angles = torch.tensor([[direction, tilt, np.pi], [roll, 0, 0]], dtype=torch.float64)
        around, about_view = rotation_from_rpy(angles)
        position = torch.from_numpy(BOARD.corners.mean(0)) - rng.uniform(0.3, 0.7) * around[:, 2]
        T = transform_from_xyzrpy(IN_BASE) @ transform(around @ about_view, position)
        branches = solver.solve(T @ invert(transform_from_xyzrpy(ON_FLANGE))).q
        reached = branches[torch.isfinite(branches).all(-1)]
        if len(reached):
            chosen.append(reached[rng.integers(len(reached))])
    return torch.stack(chosen)


def far_apart(q: Tensor, count: int) -> Tensor:
    """Joint values each of which is as far as possible from those before it (farthest-point sampling)."""
    points = torch.cat([q.cos(), q.sin()], 1)
    chosen, distance = [0], (points - points[0]).norm(dim=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = torch.minimum(distance, (points - points[chosen[-1]]).norm(dim=1))
    return q[chosen]


def images_of(true: Robot, q: Tensor, draw: int) -> Images:
    """What the camera on a true robot sees."""
    return simulate_images(true, q, CAMERA, BOARD, NOISE, torch.Generator().manual_seed(draw))


def rigid_motions(points: Tensor) -> Tensor:
    """Orthonormal basis `(3 * points, 6)` of what a rigid motion of all points moves."""
    centred = points - points.mean(0)
    shifts = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    return torch.linalg.qr(torch.cat([shifts, skew(centred)], -1).flatten(0, 1)).Q


def aligned_error(true: Tensor, estimated: Tensor) -> float:
    """Root mean square distance [m] of points after the best rigid alignment; errors are small against the arm."""
    off, basis = (true - estimated).flatten(), rigid_motions(true)
    off = off - basis @ (basis.T @ off)
    return float((off.square().sum() / len(true)).sqrt())


def bound(true: Robot, rows: Measurements, q: Tensor) -> float:
    """Cramér-Rao bound [m] of the same figure: no prior, the noise of corners and repeatability known."""
    setup = GeometricCalibrator(true, prior=None).build(rows)
    problem, point = setup.problem, setup.start
    unknown = [*range(problem.space.of("tool").stop), *setup.free_unknowns]
    everything = torch.tensor(unknown)
    here, unknowns = slice(0, rows.rows), problem.space.sensor_unknowns(point)
    motion = problem.motion(point, here, everything)
    blocks = [problem.derivative(sensor, motion, unknowns, here, everything) for sensor in problem.sensors]
    J = torch.cat([block.flatten(1) for block in blocks], 1)
    noise = float(torch.as_tensor(rows.readings["corner_noise"])[0])
    scale = torch.from_numpy(problem.space.usual_errors)[everything, None]
    covariance = torch.linalg.pinv(scale * J @ J.T * scale.T / noise**2, rtol=1e-9, hermitian=True)
    none = torch.zeros(len(q), dtype=torch.int64)
    elsewhere = replace(problem, q=q, frame=none, target=none, memory=MotionMemory())
    motion = elsewhere.motion(point, slice(0, len(q)), everything)
    moved = scale * motion.derivative[:, :3].transpose(1, 2).flatten(1)
    basis = rigid_motions(motion.position.t())
    moved = moved - (moved @ basis) @ basis.T
    return float(((covariance @ moved) * moved).sum().div(len(q)).sqrt())


def main(draws: int, count: int) -> None:
    """Print root mean squares over all draws, with their bounds."""
    nominal, rng = Robot.load("ur5"), np.random.default_rng(0)
    q = far_apart(views(nominal, CANDIDATES * count, rng), count)
    judged = {
        "region": views(nominal, VIEWS, rng),
        "workspace": torch.from_numpy(rng.uniform(-np.pi, np.pi, (POSTURES, nominal.dof))),
    }
    base = xyzrpy_from_transform(invert(transform_from_xyzrpy(IN_BASE))).numpy()
    squares, seconds = {(name, what): 0.0 for name in judged for what in ("plain", "fit", "bound")}, 0.0
    hand_eye_ratios = []
    for draw in range(draws):
        errors = np.random.default_rng(draw).standard_normal(nominal.dh.shape)
        errors *= [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        true = nominal.with_geometry(nominal.dh + errors, base=base, tool=ON_FLANGE.numpy())
        images, started = images_of(true, q, draw), time.perf_counter()
        rows = image_measurements(images, CAMERA, BOARD, False, NOISE.repeatability)
        robot = GeometricCalibrator(nominal, prior=PRIOR).fit(rows).robot
        seconds += time.perf_counter() - started
        alone = image_measurements(images, CAMERA, BOARD, False, Repeatability(0.0, 0.0))
        plain = GeometricCalibrator(nominal, prior=PRIOR).fit(alone).robot
        hand_eye = fit_base_and_tool(nominal, rows).robot
        points, *estimated = (
            forward_kinematics(one, judged["workspace"])[:, :3, 3] for one in (true, robot, hand_eye)
        )
        of_fit, of_hand_eye = (aligned_error(points, one) for one in estimated)
        hand_eye_ratios.append(of_fit / of_hand_eye)
        for name, at in judged.items():
            points = forward_kinematics(true, at)[:, :3, 3]
            for what, one in (("fit", robot), ("plain", plain)):
                squares[name, what] += aligned_error(points, forward_kinematics(one, at)[:, :3, 3]) ** 2
            squares[name, "bound"] += bound(true, rows, at) ** 2
    for name in judged:
        fit, plain, least = (1e3 * (squares[name, what] / draws) ** 0.5 for what in ("fit", "plain", "bound"))
        print(
            f"{name}: {fit:.4f} mm, Cramér-Rao bound {least:.4f} mm (ratio {fit / least:.2f}); "
            f"without the repeatability of the robot {plain:.4f} mm"
        )
    print(f"against hand-eye alone (drawn arm, workspace), worst draw: 1/{1 / max(hand_eye_ratios):.0f}")
    print(f"{count} images: {seconds / draws:.2f} s a calibration")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--images", type=int, default=50)
    arguments = parser.parse_args()
    main(arguments.draws, arguments.images)
