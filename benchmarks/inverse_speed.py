"""Speed of the corrected inverse kinematics in poses per second and microseconds per call, compared with scipy.

Run `OMP_NUM_THREADS=1 python benchmarks/inverse_speed.py` (scipy comes with `pip install -e ".[bench]"`). The arm has
errors of 0.5 mm and 1 mrad in every row, base and tool, and a correction from a Fourier series, gravity torques and
product units; every joint value is treated as measured. With a model folder instead of a robot, that model is used
within its measured joint values, or with `--anywhere` over the whole limits, mostly outside its domain. scipy solves
the same poses of the arm without its correction, starting 0.05 rad from the solution. Poses are those of uniformly
drawn joint values; they are checked before solving and the residual is computed after it. The kernels are compiled
before the measurement starts.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.compiled_model import save_compiled
from pisigma.model.folder.model_folder import load_model
from pisigma.model.inverse.compiled_ik import CompiledIK
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.status import Status

ERRORS = np.array([1e-3, 5e-4, 5e-4, 1e-3, 1e-3])
BASE, TOOL = np.array([0.4, -0.7, 0.3, 2.0, 0.5, -1.0]), np.array([0.06, -0.04, 0.13, 0.4, -0.3, 0.8])
COLD = """
import time
start, began = time.perf_counter(), time.process_time()
import numpy as np
from pisigma.model.inverse.compiled_ik import CompiledIK
CompiledIK.load({file!r}).solve(np.load({pose!r}))
print(time.perf_counter() - start, time.process_time() - began)
"""
REPEATS = 5
"""Number of runs, of which the fastest counts because other programs can only slow a run down."""


def draw_joints(robot: Robot, rows: int, rng: np.random.Generator) -> torch.Tensor:
    """Return joint values [rad or m] over the limits, within one turn at most."""
    limits = np.clip(robot.limits, -math.pi, math.pi)
    return torch.from_numpy(rng.uniform(limits[:, 0], limits[:, 1], (rows, robot.dof)))


def draw_between(starts: torch.Tensor, rows: int, rng: np.random.Generator) -> torch.Tensor:
    """Return joint values [rad or m], each between two measured values of its joint."""
    first, second = (
        starts.double()[torch.from_numpy(rng.integers(len(starts), size=rows))] for _ in range(2)
    )
    return first + torch.from_numpy(rng.uniform(size=first.shape)) * (second - first)


def make_model(name: str | Robot, harmonics: int, rng: np.random.Generator) -> CalibratedModel:
    """Return a calibrated arm with a correction of about 1 mrad, from the catalogue, a file, or another robot."""
    robot = (Robot.load(name) if isinstance(name, str) else name).with_geometry(base=BASE, tool=TOOL)
    geometric = robot.with_geometry(dh=robot.dh + ERRORS * rng.normal(size=robot.dh.shape))
    features = [FourierSeries(robot, harmonics), GravityTorques(robot)]
    correction = JointCorrection(robot, features, (2, 2))
    with torch.no_grad():
        for weight, chosen in zip(correction.linear, features, strict=True):
            weight.copy_(
                5e-4 / math.sqrt(chosen.column_count) * torch.from_numpy(rng.normal(size=weight.shape))
            )
        correction.weight.copy_(0.01 * torch.from_numpy(rng.normal(size=correction.weight.shape)))
    starts = draw_joints(robot, 400, rng)
    arm = HybridArm(geometric, correction.requires_grad_(False), JointCoverage.from_joints(robot, starts))
    return CalibratedModel(
        robot.name, "benchmark", robot, None, None, (), starts, calibrated=geometric, hybrid=arm
    )


def time_scipy(kernels: object, T: np.ndarray, q: np.ndarray) -> float:
    """Return the seconds per pose of least squares on the arm without its correction."""
    from pisigma.robot.kernels.arrays import IDENTIFIED

    def residual(joints: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        return (kernels.forward(joints[None], IDENTIFIED)[0][0, :3] - wanted[:3]).ravel()  # type: ignore[attr-defined]

    start = time.perf_counter()
    for wanted, joints in zip(T, q, strict=True):
        least_squares(residual, joints + 0.05, args=(wanted,), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return (time.perf_counter() - start) / len(T)


def main() -> None:
    """Print the figures of one robot."""
    parser = argparse.ArgumentParser()
    parser.add_argument("robot", nargs="?", default="ur10", help="Catalogue name or model folder.")
    parser.add_argument("--poses", type=int, default=100_000)
    parser.add_argument("--harmonics", type=int, default=24)
    parser.add_argument(
        "--anywhere",
        action="store_true",
        help="For a model folder, draw joint values over the whole limits, not only between measured values.",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    folder = Path(options.robot).is_dir()
    model = load_model(options.robot) if folder else make_model(options.robot, options.harmonics, rng)
    kernels = CompiledIK.from_model(model)
    drawn = (
        draw_between(model.starts, options.poses, rng)
        if folder and not options.anywhere
        else draw_joints(model.robot, options.poses, rng)
    )
    q = drawn.numpy()
    T = kernels.forward(q)[0]
    for label, near, threads in (
        ("any branch", None, 1),
        ("any branch", None, 2),
        ("near", q + 0.02, 1),
        ("near", q + 0.02, 2),
    ):
        seconds, used = math.inf, math.inf
        for _ in range(REPEATS):
            start, began = time.perf_counter(), time.process_time()
            found = kernels.solve_batch(T, near=near, threads=threads)
            seconds = min(seconds, time.perf_counter() - start)
            used = min(used, time.process_time() - began)
        reached = found.status != Status.UNREACHABLE
        print(
            f"{label}, {threads} threads: {len(T) / seconds:,.0f} poses/s, {used / len(T) * 1e6:.1f} us of processor a "
            f"pose, reached {100 * reached.mean():.2f} %, residual at most {np.nanmax(found.position_residual):.1e} m"
        )
    calls = []
    for pose in T[:20_000]:
        start = time.perf_counter()
        kernels.solve(pose)
        calls.append(time.perf_counter() - start)
    median, high = np.percentile(calls, [50, 99]) * 1e6
    print(f"one call: median {median:.1f} us, 99 % {high:.1f} us")
    few = min(200, len(T))
    scipy = time_scipy(kernels, T[:few], q[:few])
    print(f"scipy: {scipy * 1e6:,.0f} us per pose, {scipy * 1e6 / median:,.0f} times a compiled call")
    solver, tensors, rate = CorrectedIK(model), torch.from_numpy(T), 0.0
    for _ in range(REPEATS):
        start = time.perf_counter()
        solver(tensors)
        rate = max(rate, len(T) / (time.perf_counter() - start))
    print(f"tensors, any branch, {len(os.sched_getaffinity(0))} threads: {rate:,.0f} poses/s")
    with tempfile.TemporaryDirectory() as scratch:
        file, pose = str(Path(scratch) / "compiled.npz"), str(Path(scratch) / "T.npy")
        save_compiled(model, file)
        np.save(pose, T[0])
        script = COLD.format(file=file, pose=pose)
        done = [
            subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
            for _ in range(REPEATS)
        ]
        wall, used = (min(float(run.stdout.split()[i]) for run in done) for i in range(2))
        print(f"new process, import to first solution: {wall:.2f} s, {used:.2f} s of processor time")


if __name__ == "__main__":
    main()
