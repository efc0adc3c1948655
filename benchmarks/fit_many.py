"""Geometric calibration of many robots side by side against one after the other.

Run `OMP_NUM_THREADS=1 python benchmarks/fit_many.py [--robots 1000] [--rows 100]`. Every robot is a UR10 with 0.5 mm
and 1 mrad errors in all DH and Hayati parameters, base and tool unknown, position noise 0.05 mm per axis. Times are
those of the processor; of `--repeats` repeats the fastest counts.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

POSE = np.array([3.0, -1.0, 0.5, 0.4, 0.2, -0.7])
TOOL = np.array([0.02, -0.03, 0.15, 0.0, 0.0, 0.0])
LENGTH, ANGLE, NOISE = 0.5e-3, 1e-3, 0.05e-3


def measure(nominal: Robot, rows: int, seed: int) -> Measurements:
    """Measure positions of a robot of the type."""
    generator = np.random.default_rng(seed)
    sizes = np.array([ANGLE, LENGTH, LENGTH, ANGLE, ANGLE])
    dh = nominal.dh + sizes * generator.standard_normal(nominal.dh.shape)
    true = nominal.with_geometry(dh, POSE + 0.01 * generator.standard_normal(6), TOOL)
    q = torch.from_numpy(generator.uniform(-2.5, 2.5, (rows, nominal.dof)))
    noise = torch.from_numpy(NOISE * generator.standard_normal((rows, 3)))
    return Measurements(q, forward_kinematics(true, q)[:, :3, 3] + noise)


def timed(fit: Callable[[], list[CalibrationResult]], repeats: int) -> tuple[float, list[CalibrationResult]]:
    """The least processor time of some repeats [s], and the results."""
    best, results = float("inf"), []
    for _ in range(repeats):
        started = time.process_time()
        results = fit()
        best = min(best, time.process_time() - started)
    return best, results


def main() -> None:
    """Compare times and results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--rows", type=int, default=100)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    nominal = Robot.load("ur10")
    calibrator = GeometricCalibrator(nominal)
    data = [measure(nominal, options.rows, seed) for seed in range(options.robots)]
    calibrator.fit_many(data[:2])
    together, many = timed(lambda: calibrator.fit_many(data), options.repeats)
    apart, each = timed(lambda: [calibrator.fit(one) for one in data], options.repeats)
    largest = max(
        float((one.predicted_poses(rows) - other.predicted_poses(rows))[:, :3, 3].norm(dim=1).max())
        for one, other, rows in zip(many, each, data, strict=True)
    )
    count = options.robots
    print(
        f"{count} robots x {options.rows} positions, one thread: {together / count * 1e3:.2f} ms a robot side by side"
    )
    print(f"one after the other: {apart / count * 1e3:.2f} ms a robot, {apart / together:.1f} times as long")
    print(f"largest difference of predicted positions: {largest:.1e} m")


if __name__ == "__main__":
    main()
