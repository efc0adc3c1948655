"""Calibration with a camera compared with scipy's `least_squares` and OpenCV's hand-eye calibration.

    OMP_NUM_THREADS=1 python benchmarks/camera_peers.py [--draws 20] [--images 50]

Set-up and errors are those of `benchmarks/camera.py`, with the intrinsics under their prior. scipy's unknowns are the
arm, the poses of camera and board, the pose error of every image, and the intrinsics; its residuals are pixels and
priors in units of their standard deviations, its Jacobian is computed by finite differences with the sparsity due to
the separate pose error of each image. It starts from the same values as pisigma and stops at 1e-8. OpenCV's five
methods use the nominal robot and the exact intrinsics; they are part of opencv-python-headless 4, not of 5:

    pip install --target cv4 "opencv-python-headless<5" && PYTHONPATH=cv4:$PYTHONPATH python benchmarks/camera_peers.py
"""

import argparse
import time

import cv2
import numpy as np
import torch
from camera import ANGLE, BOARD, CAMERA, LENGTH, NOISE, PRIOR, Cell, Draw, aligned_error, positions
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, lil_matrix

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import invert, rotation_from_vector

METHODS = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
FREE = np.flatnonzero(USUAL_DEVIATIONS)


class WholeProblem:
    """All unknowns in one vector, in units of their prior standard deviations (1 mm and 1 mrad for base and tool)."""

    def __init__(self, start: Robot, draw: Draw) -> None:
        self.robot, self.draw = start, draw
        self.count = len(draw.images.names)
        self.pixels = np.concatenate(draw.images.pixels)
        self.image = np.repeat(np.arange(self.count), [len(one) for one in draw.images.corner_numbers])
        self.corners = BOARD.corners[np.concatenate(draw.images.corner_numbers)]
        self.shared = start.dh.size + 12 + len(FREE)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.shared + 6 * self.count

    def split(self, x: np.ndarray) -> tuple[Robot, Camera, np.ndarray]:
        """Return the robot, the camera and the pose errors of all images [m, rad]."""
        arm, start = self.robot.dh.size, self.robot
        dh = start.dh + x[:arm].reshape(-1, 5) * [ANGLE, LENGTH, LENGTH, ANGLE, ANGLE]
        base, tool = start.base + 1e-3 * x[arm : arm + 6], start.tool + 1e-3 * x[arm + 6 : arm + 12]
        intrinsics = self.draw.stated.intrinsics
        intrinsics[FREE] += x[arm + 12 : self.shared] * np.array(USUAL_DEVIATIONS)[FREE]
        noise = NOISE.repeatability
        errors = x[self.shared :].reshape(-1, 6) * np.repeat([noise.length, noise.angle], 3)
        return start.with_geometry(dh, base, tool), self.draw.stated.with_intrinsics(intrinsics), errors

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Return residuals of pixels and priors, in standard deviations."""
        robot, camera, errors = self.split(x)
        T = forward_kinematics(robot, self.draw.images.q).numpy()
        R = rotation_from_vector(torch.from_numpy(errors[:, 3:])).numpy() @ T[:, :3, :3]
        t = T[:, :3, 3] + errors[:, :3]
        points = np.einsum("nji,nj->ni", R[self.image], self.corners - t[self.image])
        arm, known = self.robot.dh.size, x[self.robot.dh.size + 12 :]
        return np.concatenate(
            [((self.pixels - camera.project(points)[0]) / NOISE.corner).ravel(), x[:arm], known]
        )

    def sparsity(self) -> csr_matrix:
        """Return the sparsity of the Jacobian."""
        values, arm = 2 * len(self.pixels), self.robot.dh.size
        pattern = lil_matrix((values + arm + self.size - arm - 12, self.size), dtype=np.int8)
        pattern[:values, : self.shared] = 1
        for k in range(6):
            pattern[np.arange(values), self.shared + 6 * np.repeat(self.image, 2) + k] = 1
        priors = np.concatenate([np.arange(arm), np.arange(arm + 12, self.size)])
        pattern[values + np.arange(len(priors)), priors] = 1
        return pattern.tocsr()


def by_scipy(start: Robot, draw: Draw) -> Robot:
    """Return the robot that scipy estimates."""
    whole = WholeProblem(start, draw)
    solution = least_squares(
        whole.residual, np.zeros(whole.size), jac_sparsity=whole.sparsity(), x_scale="jac", tr_solver="lsmr"
    )
    return whole.split(solution.x)[0]


def by_opencv(cell: Cell, draw: Draw) -> list[Robot]:
    """Return the nominal robot with the hand-eye calibration of every method."""
    rows = image_measurements(draw.images, CAMERA, BOARD, False, Repeatability(0.0, 0.0), "fixed")
    flange = forward_kinematics(
        cell.nominal.with_geometry(base=np.zeros(6), tool=np.zeros(6)), rows.q
    ).numpy()
    board = invert(rows.T).numpy()
    robots = []
    for name in METHODS:
        R, t = cv2.calibrateHandEye(  # type: ignore[attr-defined]  # not in the stubs
            list(flange[:, :3, :3]),
            list(flange[:, :3, 3]),
            list(board[:, :3, :3]),
            list(board[:, :3, 3]),
            method=getattr(cv2, f"CALIB_HAND_EYE_{name}"),
        )
        robots.append(robot_with_hand_eye(cell.nominal, R, t[:, 0]))
    return robots


def robot_with_hand_eye(nominal: Robot, R: np.ndarray, t: np.ndarray) -> Robot:
    """Return a robot with the camera at a pose on its flange; only the centre of the camera is used here."""
    return nominal.with_geometry(base=np.zeros(6), tool=np.concatenate([t, np.zeros(3)]))


def main(draws: int, count: int) -> None:
    """Print accuracies over the workspace, times, and the lowest ratio to hand-eye calibration alone."""
    cell = Cell.with_images(count)
    q, methods = cell.judged["workspace"], hasattr(cv2, "calibrateHandEye")
    errors, seconds, ratios = {"pisigma": 0.0, "scipy": 0.0}, {"pisigma": 0.0, "scipy": 0.0}, []
    for number in range(draws):
        draw = cell.draw(number)
        true = positions(draw.true, q)
        started = time.process_time()
        rows = draw.rows("prior")
        ours = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(rows).robot
        seconds["pisigma"] += time.process_time() - started
        start = fit_base_and_tool(cell.nominal, rows).robot
        started = time.process_time()
        theirs = by_scipy(start, draw)
        seconds["scipy"] += time.process_time() - started
        for name, robot in (("pisigma", ours), ("scipy", theirs)):
            errors[name] += aligned_error(true, positions(robot, q)) ** 2 / draws
        if methods:
            best = min(aligned_error(true, positions(robot, q)) for robot in by_opencv(cell, draw))
            known = GeometricCalibrator(cell.nominal, prior=PRIOR).fit(draw.rows("fixed")).robot
            ratios.append(best / aligned_error(true, positions(known, q)))
    for name, square in errors.items():
        print(
            f"{name}: {1e3 * square**0.5:.4f} mm over the workspace, {seconds[name] / draws:.2f} s of processor time"
        )
    print(f"scipy takes {seconds['scipy'] / seconds['pisigma']:.1f} times as long")
    if methods:
        print(
            f"the most accurate of OpenCV's methods has at least {min(ratios):.0f} times the error in every draw"
        )
    else:
        print("OpenCV 5 has no hand-eye calibration for Python; see above for how to run it with OpenCV 4")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--images", type=int, default=50)
    arguments = parser.parse_args()
    main(arguments.draws, arguments.images)
