"""Coverage of predicted errors of a calibration with a camera, and correction of the board's scale by one distance.

    OMP_NUM_THREADS=1 python benchmarks/camera_uncertainty.py [--draws 30]

Set-up and errors are those of `benchmarks/camera.py`. Coverage is the share of the position coordinates over the whole
joint space, pooled over draws, with errors within the 95 % intervals that `pisigma calibrate` predicts. In a second
part, the board is 0.1 % larger than stated, and a ball on the flange sits six times in each of two sockets whose
distance of 600 mm is known to 0.01 mm; the repeatability of the robot is 0.02 mm.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch
from camera import BOARD, CAMERA, NOISE, PRIOR, Cell, Draw, aligned_error, positions
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.measurement.camera.camera_files import IntrinsicsChoice
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements, join
from pisigma.model.accuracy import sigma_of_rows
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form.registry import closed_form_solver
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.se3 import invert, rotation_from_zyx, transform, transform_from_xyz_zyx

CHOICES: tuple[IntrinsicsChoice, ...] = ("fixed", "prior", "free")
WITHIN_95 = 1.959964
SCALE, APART, TIMES = 1e-3, 0.6, 6
BALL = torch.tensor([0.0, 0.08, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)
"""Target on the flange."""


def inside(cell: Cell, draw: Draw, choice: IntrinsicsChoice) -> Tensor:
    """Return whether every coordinate over the workspace is within its predicted 95 % interval."""
    rows, q = draw.rows(choice), cell.judged["workspace"]
    result = HybridCalibrator(GeometricCalibrator(cell.nominal, prior=PRIOR)).fit(rows)
    model = model_of_hybrid("ur5", cell.nominal, result, rows)
    at = Measurements(q=q, frame=rows.frame[:1] * len(q), target=rows.target[:1] * len(q))
    error = poses_of_rows(model, at)[:, :3, 3] - positions(draw.true, q)
    return error.abs() < WITHIN_95 * sigma_of_rows(model, at)


def in_sockets(nominal: Robot, true: Robot, rng: np.random.Generator) -> Measurements:
    """Return rows with the ball of a true robot in two sockets, with random orientations and branches."""
    solver, rows, names = closed_form_solver(nominal), list[Tensor](), list[str]()
    assert solver is not None
    ball = true.with_geometry(base=np.zeros(6), tool=BALL.numpy())
    for name, y in (("a", -APART / 2), ("b", APART / 2)):
        socket = torch.tensor([0.45, y, 0.1], dtype=torch.float64)
        while names.count(name) < TIMES:
            turn = torch.from_numpy(rng.uniform((-np.pi, -0.6, np.pi - 0.6), (np.pi, 0.6, np.pi + 0.6)))
            T = transform(rotation_from_zyx(turn), socket) @ invert(transform_from_xyz_zyx(BALL))
            branches = solver.solve(T[None]).q[0]
            reached = branches[torch.isfinite(branches).all(-1)]
            if not len(reached):
                continue
            q = reached[rng.integers(len(reached))]
            wanted = socket + NOISE.repeatability.length * torch.from_numpy(rng.standard_normal(3))
            for _ in range(10):
                off = wanted - forward_kinematics(ball, q)[:3, 3]
                q = q + torch.linalg.pinv(joint_jacobian(ball, q)[1][:3]) @ off
            rows.append(q)
            names.append(name)
    return Measurements(
        q=torch.stack(rows), socket=tuple(names), frame=("sockets",) * len(rows), target=("ball",) * len(rows)
    )


def main(draws: int) -> None:
    """Print coverages, and errors of the estimated scale."""
    cell = Cell.with_images(50)
    for choice in CHOICES:
        share = torch.stack(
            [inside(cell, cell.draw(number), choice).double().mean() for number in range(draws)]
        )
        print(
            f"predicted 95 % intervals, intrinsics {choice}: contain {float(share.mean()):.1%} of the coordinates"
        )
    smaller = replace(BOARD, square=BOARD.square / (1 + SCALE))
    q = cell.judged["workspace"]
    for choice in CHOICES:
        off, squares = [], np.zeros(2)
        for number in range(draws):
            draw = cell.draw(number)
            camera = CAMERA if choice == "fixed" else draw.stated
            rows = image_measurements(draw.images, camera, smaller, False, NOISE.repeatability, choice)
            sockets = in_sockets(cell.nominal, draw.true, np.random.default_rng(number))
            alone = GeometricCalibrator(cell.nominal, prior=PRIOR)
            with_distance = replace(alone, socket_distances={("a", "b"): APART})
            results = (alone.fit(rows), with_distance.fit(join([rows, sockets])))
            true = positions(draw.true, q)
            squares += [aligned_error(true, positions(one.robot, q)) ** 2 / draws for one in results]
            off.append(results[1].parameter("board_board_scale").estimated - SCALE)
        without, with_one = 1e3 * squares**0.5
        print(
            f"board 0.1 % too large, intrinsics {choice}: found within {100 * np.sqrt(np.mean(np.square(off))):.4f} % "
            f"(RMS; worst {100 * np.abs(off).max():.4f} %); over the workspace {without:.3f} mm without the distance, "
            f"{with_one:.3f} mm with it"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=30)
    main(parser.parse_args().draws)
