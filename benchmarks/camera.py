"""Compare the true error of a UR5 calibrated with a camera on its flange with the Cramér-Rao bound.

    OMP_NUM_THREADS=1 python benchmarks/camera.py [--draws 20] [--images 50]

True arms have errors of 1 mm and 0.3 deg in every parameter. The camera (1920 x 1200 px, f = 1400 px) views a board of
9 x 6 corners 30 mm apart from 0.3 to 0.7 m, tilted by up to 40 deg; the noise of the corners is 0.3 px, the
repeatability of the robot 0.02 mm and 0.01 deg. The intrinsics are known, or stated by a typical calibration with
errors of the stated standard deviations (fx, fy 0.5 px; cx, cy 1 px; k1 0.002; k2 0.01; p1, p2 2e-4); the stated
intrinsics are used as prior, ignored (free), or taken as true (held). Errors are those of the camera centre's position
after the best rigid alignment, over other views of the board (region) and over 400 postures of the whole joint space
(workspace), pooled over draws. The bound includes the prior of the intrinsics, but not that of the arm.
"""

import argparse
import resource
import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.geometric.problem.problem import MotionMemory
from pisigma.measurement.camera.board import Board
from pisigma.measurement.camera.camera import INTRINSICS, USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice, Repeatability
from pisigma.measurement.camera.image_rows import Images, image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import (
    invert,
    rotation_from_zyx,
    skew,
    transform,
    transform_from_xyz_zyx,
    xyz_zyx_from_transform,
)
from pisigma.simulation.camera.simulated_images import ImageNoise, select_far_apart, simulate_images

LENGTH, ANGLE = 1e-3, np.deg2rad(0.3)
CAMERA = Camera("wrist", 1920, 1200, 1400.0, 1400.0, 960.0, 600.0)
BOARD = Board("board", 6, 9, 0.03)
ON_FLANGE = torch.tensor([0.03, 0.02, 0.06, 0.1, 0.02, -0.03], dtype=torch.float64)
IN_BASE = torch.tensor([0.42, -0.12, 0.05, 0.0, 0.0, 0.0], dtype=torch.float64)
NOISE = ImageNoise()
CANDIDATES, POSTURES, VIEWS = 8, 400, 200
PRIOR = Prior(theta=ANGLE, d=LENGTH, a=LENGTH, alpha=ANGLE, beta=ANGLE)


def views(robot: Robot, count: int, rng: np.random.Generator) -> Tensor:
    """Return joint values [rad] of random views of the board, each with a random branch of the arm."""
    solver, chosen = closed_form_solver(robot), list[Tensor]()
    assert solver is not None
    while len(chosen) < count:
        tilt, direction, roll = rng.uniform((0, 0, 0), (np.deg2rad(40), 2 * np.pi, 2 * np.pi))
        angles = torch.tensor([[direction, tilt, np.pi], [roll, 0, 0]], dtype=torch.float64)
        around, about_view = rotation_from_zyx(angles)
        position = torch.from_numpy(BOARD.corners.mean(0)) - rng.uniform(0.3, 0.7) * around[:, 2]
        T = transform_from_xyz_zyx(IN_BASE) @ transform(around @ about_view, position)
        branches = solver.solve(T @ invert(transform_from_xyz_zyx(ON_FLANGE))).q
        reached = branches[torch.isfinite(branches).all(-1)]
        if len(reached):
            chosen.append(reached[rng.integers(len(reached))])
    return torch.stack(chosen)


@dataclass(frozen=True, eq=False)
class Draw:
    """A true arm, its images, and the camera as stated by a typical calibration."""

    true: Robot
    images: Images
    stated: Camera

    def rows(
        self, intrinsics: IntrinsicsChoice, repeatability: Repeatability = NOISE.repeatability
    ) -> Measurements:
        """Return the images as measurements, with exact intrinsics if they are fixed."""
        camera = CAMERA if intrinsics == "fixed" else self.stated
        return image_measurements(self.images, camera, BOARD, False, repeatability, intrinsics)


@dataclass(frozen=True, eq=False)
class Cell:
    """A nominal robot, joint values of its images, and the postures for evaluation by name."""

    nominal: Robot
    q: Tensor
    judged: dict[str, Tensor]

    @staticmethod
    def with_images(count: int) -> "Cell":
        """Return the cell with a number of images."""
        nominal, rng = Robot.load("ur5"), np.random.default_rng(0)
        q = select_far_apart(views(nominal, CANDIDATES * count, rng), count)
        everywhere = rng.uniform(-np.pi, np.pi, (POSTURES, nominal.dof))
        return Cell(
            nominal, q, {"region": views(nominal, VIEWS, rng), "workspace": torch.from_numpy(everywhere)}
        )

    def draw(self, number: int) -> Draw:
        """Return a true arm with errors of 1 mm and 0.3 deg, and intrinsics with errors as their calibration states."""
        rng = np.random.default_rng(number)
        errors = rng.standard_normal(self.nominal.dh.shape) * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        base = xyz_zyx_from_transform(invert(transform_from_xyz_zyx(IN_BASE))).numpy()
        true = self.nominal.with_geometry(self.nominal.dh + errors, base=base, tool=ON_FLANGE.numpy())
        images = simulate_images(true, self.q, CAMERA, BOARD, NOISE, torch.Generator().manual_seed(number))
        off = rng.standard_normal(len(INTRINSICS)) * USUAL_DEVIATIONS
        return Draw(true, images, CAMERA.with_intrinsics(CAMERA.intrinsics + off))


def positions(robot: Robot, q: Tensor) -> Tensor:
    """Return the position of the camera's centre [m]."""
    return forward_kinematics(robot, q)[:, :3, 3]


def rigid_motions(points: Tensor) -> Tensor:
    """Return an orthonormal basis `(3 * points, 6)` of the rigid motions of all points."""
    centred = points - points.mean(0)
    shifts = torch.eye(3, dtype=torch.float64).expand(len(points), 3, 3)
    return torch.linalg.qr(torch.cat([shifts, skew(centred)], -1).flatten(0, 1)).Q


def aligned_error(true: Tensor, estimated: Tensor) -> float:
    """Return the RMS distance [m] of points after the best rigid alignment, for errors small compared with the arm."""
    off, basis = (true - estimated).flatten(), rigid_motions(true)
    off = off - basis @ (basis.T @ off)
    return float((off.square().sum() / len(true)).sqrt())


def bound(true: Robot, rows: Measurements, q: Tensor) -> float:
    """Return the Cramér-Rao bound [m] of `aligned_error` without a prior, for known noise of corners and robot."""
    setup = GeometricCalibrator(true, prior=None).build(rows)
    problem, point = setup.problem, setup.start
    unknown = [*range(problem.space.indices_of("tool").stop), *setup.free_unknowns]
    everything = torch.tensor(unknown)
    here, unknowns = slice(0, rows.rows), problem.space.sensor_unknowns(point)
    motion = problem.motion(point, here, everything)
    blocks = [
        problem.prediction_derivative(sensor, motion, unknowns, here, everything)
        for sensor in problem.sensors
    ]
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


CHOICES: dict[str, IntrinsicsChoice] = {
    "intrinsics known": "fixed",
    "under their prior": "prior",
    "free": "free",
}


def main(draws: int, count: int) -> None:
    """Print root mean squares over all draws, with their bounds."""
    cell = Cell.with_images(count)
    squares: dict[tuple[str, str], list[tuple[float, float]]] = {}
    seconds = dict.fromkeys(CHOICES, 0.0)

    def judge(label: str, true: Robot, robot: Robot, rows: Measurements) -> None:
        for name, q in cell.judged.items():
            error = aligned_error(positions(true, q), positions(robot, q))
            squares.setdefault((label, name), []).append((error**2, bound(true, rows, q) ** 2))

    for number in range(draws):
        draw = cell.draw(number)
        for label, choice in CHOICES.items():
            started = time.perf_counter()
            rows = draw.rows(choice)
            robot = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(rows).robot
            seconds[label] += time.perf_counter() - started
            judge(label, draw.true, robot, rows)
        exact = draw.rows("fixed")
        wrong = image_measurements(draw.images, draw.stated, BOARD, False, NOISE.repeatability, "fixed")
        plain = draw.rows("fixed", Repeatability(0.0, 0.0))
        for label, rows in (("held as stated", wrong), ("known, without the repeatability", plain)):
            judge(label, draw.true, GeometricCalibrator(cell.nominal, prior=PRIOR).fit(rows).robot, exact)
    for (label, name), pairs in squares.items():
        error, least = (1e3 * np.sqrt(np.mean(pairs, 0))).tolist()
        print(f"{label}, {name}: {error:.4f} mm, Cramér-Rao bound {least:.4f} mm (ratio {error / least:.2f})")
    times = ", ".join(f"{label} {total / draws:.2f} s" for label, total in seconds.items())
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"a calibration of {count} images: {times}; {memory:.0f} MB at most in the whole benchmark")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--images", type=int, default=50)
    arguments = parser.parse_args()
    main(arguments.draws, arguments.images)
