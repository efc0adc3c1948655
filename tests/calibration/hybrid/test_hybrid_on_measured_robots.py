"""The hybrid on measured robots; data of P. Jacobi 2025 and D. Burakov 2020."""

import math
from pathlib import Path

import torch
from testing.models import no_type_checker

from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot


def rms(result: HybridResult | CalibrationResult, measurements: Measurements) -> float:
    """Of the errors' lengths [m]."""
    return float(result.errors_of(measurements)["position"].square().sum(1).mean().sqrt())


def calibrator(robot: Robot) -> HybridCalibrator:
    return HybridCalibrator(robot, harmonics=(8, 24), products=False)


def test_ur5_beyond_half_of_a_joints_range(shared_data: Path) -> None:
    """Trained where a joint is below its median, judged above: the posterior's mean is the best guess there too."""
    data, robot = Measurements.read_csv(shared_data / "ur5" / "grid.csv"), Robot.load("ur5")
    ratios = []
    with no_type_checker():
        for joint in (0, 1, 3):
            half = data.q[:, joint] < data.q[:, joint].median()
            result, rest = (
                HybridCalibrator(robot, harmonics=(8, 24, 56)).fit(data.select(half)),
                data.select(~half),
            )
            ratios.append(rms(result, rest) / rms(result.geometric, rest))
    assert max(ratios) < 1.15
    assert math.prod(ratios) ** (1 / 3) < 0.75


def test_ur5_with_100_poses(shared_data: Path) -> None:
    data, robot = Measurements.read_csv(shared_data / "ur5" / "grid.csv"), Robot.load("ur5")
    order = torch.randperm(data.rows, generator=torch.Generator().manual_seed(0))
    train, test = data.select(order[:100]), data.select(order[100:])
    with no_type_checker():
        result = calibrator(robot).fit(train)
        assert rms(result.geometric, test) > 0.11e-3
        assert rms(result, test) < 0.085e-3


def test_twenty_poses_of_the_fanuc_do_not_increase_the_error(shared_data: Path) -> None:
    """24 poses, of which six measurements each are used; RMS over six folds of the poses."""
    data = Measurements.read_csv(shared_data / "fanuc_r2000" / "positions.csv")
    data = data.select(torch.arange(0, data.rows, 5))
    poses = torch.unique(data.q, dim=0, return_inverse=True)[1]
    square = {"hybrid": 0.0, "geometric": 0.0}
    with no_type_checker():
        for fold in range(6):
            tested = poses % 6 == fold
            result = calibrator(Robot.load("fanuc_r2000")).fit(data.select(~tested))
            test = data.select(tested)
            square["hybrid"] += test.rows * rms(result, test) ** 2
            square["geometric"] += test.rows * rms(result.geometric, test) ** 2
    assert (square["hybrid"] / square["geometric"]) ** 0.5 < 1.02
