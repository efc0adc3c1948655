"""Accuracy of calibrations from chosen and from random poses, and predictions of it.

Run `OMP_NUM_THREADS=1 python benchmarks/planning.py [PART ...]` with the measured files in `PISIGMA_DATA`, and the
simulator of arms (`sim.py`) in `PISIGMA_SIMULATED`. For measured robots, some rows are chosen from pools of 400 random
rows, and the model is evaluated on all other rows. For simulated arms, candidates are drawn within the joint limits,
and the model is evaluated at 400 poses without noise. Every figure is a root mean square of position errors [mm].
"""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.planning.expected_accuracy import rms_of
from pisigma.planning.plan_settings import Criterion
from pisigma.planning.pose_selection import select_poses
from pisigma.planning.robot_posterior import Instrument, RobotPosterior
from pisigma.robot import Robot
from pisigma.validation.held_out.few_rows import fit_if_better
from pisigma.validation.held_out.trained_calibrations import Calibrator, Result

DATA = Path(os.environ.get("PISIGMA_DATA", "../shared/data"))
SIMULATED = Path(os.environ.get("PISIGMA_SIMULATED", "../shared/simulated"))
POOL = 400
ARMS = ("kr10", "irb120", "arm7")
NOISE = 3.6e-5
"""Standard deviation of a coordinate due to the simulated sensor and the robot's repeatability together [m]."""
LIMIT = 0.1
"""Accuracy [mm] that is reached by the counted poses."""
STEPS = (14, 18, 22, 26, 30, 34, 38, 42, 46, 50, 56, 62, 70, 80)


@dataclass(frozen=True)
class Figures:
    """Result of one choice [mm]: true RMS, RMS predicted before measuring, and RMS predicted by the calibration."""

    true: float
    predicted: float
    after: float


def rms_mm(result: Result, test: Measurements) -> float:
    """Return the RMS of the position errors of a calibration [mm]."""
    return float(result.errors_of(test)["position"].square().sum(1).mean().sqrt()) * 1e3


def pools(name: str, draws: range) -> Iterator[tuple[Measurements, Measurements]]:
    """Return pools of measured rows, each with all other rows."""
    file = {"ur10": "ur10/series_c_train.csv", "ur5": "ur5/grid.csv"}[name]
    data = Measurements.read_csv(DATA / file, Robot.load(name))
    for draw in draws:
        order = torch.randperm(data.rows, generator=torch.Generator().manual_seed(draw))
        yield data.select(order[:POOL]), data.select(order[POOL:])


def measured(
    name: str, counts: tuple[int, ...], hybrid: bool, draws: range, criteria: tuple[Criterion, ...]
) -> None:
    """Compare random rows of a pool with chosen rows."""
    robot = Robot.load(name)
    posterior = RobotPosterior.from_robot(robot, hybrid=hybrid)
    calibrator: Calibrator = HybridCalibrator(robot) if hybrid else GeometricCalibrator(robot)
    table: dict[tuple[int, str], list[float]] = {}
    for pool, test in pools(name, draws):
        for count in counts:
            rows: dict[str, Tensor] = {"random": torch.arange(count)}
            rows |= {
                one: select_poses(
                    posterior.sensitivities(pool.q), posterior.tool_derivatives(pool.q[:300]), count, one
                )
                for one in criteria
            }
            for how, chosen in rows.items():
                rms = rms_mm(calibrator.fit(pool.select(chosen)), test)
                table.setdefault((count, how), []).append(rms)
    show(name, table)


def sequential(name: str, counts: tuple[int, ...], draws: range) -> None:
    """Choose poses in rounds, each with the posterior of a hybrid fitted to the earlier poses."""
    robot = Robot.load(name)
    table: dict[tuple[int, str], list[float]] = {}
    for pool, test in pools(name, draws):
        posterior, chosen = RobotPosterior.from_robot(robot), torch.arange(0)
        for count in counts:
            free = torch.arange(POOL)[~torch.isin(torch.arange(POOL), chosen)]
            more = select_poses(
                posterior.sensitivities(pool.q[free]),
                posterior.tool_derivatives(pool.q[:300]),
                count - len(chosen),
                "I",
            )
            chosen = torch.cat([chosen, free[more]])
            result = HybridCalibrator(robot).fit(pool.select(chosen))
            posterior = RobotPosterior.from_result(result, posterior.instrument)
            table.setdefault((count, "rounds"), []).append(rms_mm(result, test))
    show(name, table)


def show(name: str, table: dict[tuple[int, str], list[float]]) -> None:
    """Print the mean over the pools, its standard error, and the range."""
    for (count, how), values in table.items():
        error = np.std(values) / max(len(values) - 1, 1) ** 0.5
        spread = f"{min(values):.3f} to {max(values):.3f}"
        print(f"{name} {count:3d} poses {how:6s} {np.mean(values):.4f} ± {error:.4f}  ({spread})", flush=True)


class Arm:
    """A simulated arm: the nominal robot, the candidates, and the true robot."""

    def __init__(self, name: str, seed: int) -> None:
        sys.path.insert(0, str(SIMULATED))
        import sim  # type: ignore[import-not-found]

        self.true: Any = sim.True_(name, seed=seed)
        with TemporaryDirectory() as folder:
            with contextlib.chdir(folder):
                sim.write_urdf(name)
            self.nominal = Robot.load(f"{folder}/{name}.urdf")
        self.planned = self.nominal.with_geometry(tool=np.array([*self.true.tool, 0.0, 0.0, 0.0]))
        self.seed = seed
        joints = torch.from_numpy(self.true.sample(400, 2000 + seed))
        self.test = self.rows(joints, 0.0)

    def rows(self, q: Tensor, noise: float = 3e-5) -> Measurements:
        """Return positions measured by a tracker; the repeatability of the robot is 0.02 mm."""
        rng, repeatability = np.random.default_rng(self.seed + 5), 2e-5 if noise else 0.0
        position, _ = self.true.measure(q.numpy(), noise=noise, rng=rng, rep=repeatability)
        return Measurements(q=q, position=torch.from_numpy(position))

    def candidates(self, count: int) -> Tensor:
        """Return joint values with the tool above the floor."""
        return torch.from_numpy(self.true.sample(count, 1000 + self.seed))

    def figures(self, q: Tensor, posterior: RobotPosterior) -> Figures:
        """Return the result for measured poses."""
        result = fit_if_better(HybridCalibrator(self.nominal), self.rows(q), lambda what: None)
        assert isinstance(result, HybridResult)
        both = posterior.after_measuring(q), RobotPosterior.from_result(result, posterior.instrument)
        return Figures(
            rms_mm(result, self.test), *(rms_of(one.tool_derivatives(self.test.q)) * 1e3 for one in both)
        )


def predicted(seeds: range) -> None:
    """Print the ratios of predicted to true RMS at 15, 30 and 60 chosen poses, for the plan and the calibration."""
    ratios: dict[tuple[int, str], list[float]] = {}
    for seed in seeds:
        arm = Arm(ARMS[seed % len(ARMS)], seed)
        posterior, q = RobotPosterior.from_robot(arm.planned, Instrument(sigma=NOISE)), arm.candidates(1000)
        for count in (15, 30, 60):
            chosen = q[
                select_poses(posterior.sensitivities(q), posterior.tool_derivatives(q[:300]), count, "I")
            ]
            one = arm.figures(chosen, posterior)
            ratios.setdefault((count, "plan"), []).append(one.predicted / one.true)
            ratios.setdefault((count, "calibration"), []).append(one.after / one.true)
    for (count, who), values in ratios.items():
        print(
            f"{who}: predicted over true RMS, {count} chosen poses, {len(values)} arms: "
            f"median {np.median(values):.2f}, {min(values):.2f} to {max(values):.2f}",
            flush=True,
        )


def needed(seeds: range) -> None:
    """Print the ratio of chosen to random poses that reach 0.1 mm."""
    ratios = []
    for name in ARMS:
        for seed in seeds:
            arm = Arm(name, seed)
            posterior, q = (
                RobotPosterior.from_robot(arm.planned, Instrument(sigma=NOISE)),
                arm.candidates(1000),
            )
            order = select_poses(
                posterior.sensitivities(q), posterior.tool_derivatives(q[:300]), STEPS[-1], "I"
            )
            poses = [first(arm, rows, posterior) for rows in (q, q[order])]
            ratios.append(poses[1] / poses[0])
            print(f"{name} seed {seed}: {poses[0]:.0f} random, {poses[1]:.0f} chosen", flush=True)
    print(f"poses to {LIMIT} mm, chosen over random: {np.mean(ratios):.2f} ({len(ratios)} arms)")


def first(arm: Arm, q: Tensor, posterior: RobotPosterior) -> float:
    """Return the number of poses at which errors pass the limit, by logarithmic interpolation between `STEPS`."""
    before: tuple[float, float] | None = None
    for count in STEPS:
        error = arm.figures(q[:count], posterior).true
        if error <= LIMIT:
            if before is None:
                return float(count)
            share = np.log(before[1] / LIMIT) / np.log(before[1] / error)
            return float(before[0] + share * (count - before[0]))
        before = (float(count), error)
    return float(STEPS[-1])


def speed() -> None:
    """Time the choice of 100 of 5,000 candidates."""
    robot = Robot.load("ur10")
    generator = torch.Generator().manual_seed(0)
    q = (torch.rand(5000, robot.dof, generator=generator, dtype=torch.float64) * 2 - 1) * np.pi
    posterior = RobotPosterior.from_robot(robot)
    for criterion in ("D", "I"):
        began = time.perf_counter()
        select_poses(posterior.sensitivities(q), posterior.tool_derivatives(q[:300]), 100, criterion)  # type: ignore[arg-type]
        seconds = time.perf_counter() - began
        unknowns = len(posterior.uncertainty.dense_root)
        print(
            f"100 of 5,000 candidates, {unknowns} unknowns, criterion {criterion}: {seconds:.1f} s",
            flush=True,
        )


def main() -> None:
    """Print the figures of the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = ("ur10", "rounds", "ur5", "predicted", "needed", "speed")
    parser.add_argument("parts", nargs="*", default=list(parts), metavar="PART", help=", ".join(parts))
    parser.add_argument(
        "--draws", type=int, default=10, help="Number of pools, or of simulated arms of a kind."
    )
    parser.add_argument("--first", type=int, default=0, help="Seed of the first draw.")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.draws)
    both: tuple[Criterion, ...] = ("D", "I")
    run: dict[str, Callable[[], None]] = {
        "ur10": lambda: measured("ur10", (15, 30, 50, 100), True, seeds, both),
        "rounds": lambda: sequential("ur10", (20, 30, 40, 50), seeds),
        "ur5": lambda: measured("ur5", (10, 15), False, seeds, both),
        "predicted": lambda: predicted(seeds),
        "needed": lambda: needed(seeds),
        "speed": speed,
    }
    for part in arguments.parts:
        run[part]()


if __name__ == "__main__":
    main()
