"""Held-out errors on real robots; data of C. Landgraf 2021, P. Jacobi 2025 and D. Burakov 2020."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.initial_guess.base_and_tool import fit_base_and_tool
from pisigma.calibration.geometric.prediction import predicted_poses
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.registry import measured_errors
from pisigma.measurement.splits import k_folds
from pisigma.robot import Robot


def folds(measurements: Measurements, count: int, seed: int) -> torch.Tensor:
    """Fold of every row; rows of equal joint values stay together."""
    _, pose = np.unique(measurements.q.numpy().round(6), axis=0, return_inverse=True)
    order = np.random.default_rng(seed).permutation(pose.max() + 1)
    return torch.from_numpy((np.argsort(order) % count)[pose.ravel()])


def held_out(robot: Robot, data: Measurements, count: int, seed: int = 0) -> dict[str, float]:
    """RMS of held-out errors' lengths [m, rad], of base and tool alone and of the calibration."""
    parts: dict[str, list[torch.Tensor]] = {}
    fold = folds(data, count, seed)
    for number in range(count):
        train, test = data.select(fold != number), data.select(fold == number)
        fit = fit_base_and_tool(robot, train)
        nominal = predicted_poses(robot, {"": fit.robot.base}, fit.tools, test)
        for name, errors in (
            ("nominal", measured_errors(nominal, test, {})),
            ("calibrated", GeometricCalibrator(robot).fit(train).errors_of(test)),
        ):
            for sensor, values in errors.items():
                parts.setdefault(f"{name} {sensor}", []).append(values)
    return {name: float(torch.cat(part).square().sum(-1).mean().sqrt()) for name, part in parts.items()}


def test_ur5_grid(shared_data: Path) -> None:
    found = held_out(Robot.load("ur5"), Measurements.read_csv(shared_data / "ur5" / "grid.csv"), 5)
    assert found["nominal position"] == pytest.approx(0.706e-3, abs=0.01e-3)
    assert found["calibrated position"] < 0.115e-3


def test_ur10_poses(shared_data: Path) -> None:
    data = Measurements.read_csv(shared_data / "ur10" / "series_c_train.csv")
    found = held_out(Robot.load("ur10"), data, 3)
    assert found["nominal position"] == pytest.approx(0.99e-3, abs=0.01e-3)
    assert found["calibrated position"] < 0.50e-3
    assert found["calibrated rotation"] < found["nominal rotation"]


def test_ur10_positions_do_not_ruin_the_orientation(shared_data: Path) -> None:
    data = Measurements.read_csv(shared_data / "ur10" / "series_c_train.csv")
    robot = Robot.load("ur10")
    positions = Measurements(q=data.q, position=data.position)
    result = GeometricCalibrator(robot).fit(positions)
    assert fit_base_and_tool(result.robot, data).rms_rotation < fit_base_and_tool(robot, data).rms_rotation
    assert len(result.weak_directions) == 2
    assert "theta_6" in [warning.subject for warning in result.warning_details]


def test_fanuc_configurations(shared_data: Path) -> None:
    data = Measurements.read_csv(shared_data / "fanuc_r2000" / "positions.csv")
    robot = Robot.load("fanuc_r2000")
    assert ((data.q.numpy() >= robot.limits[:, 0]) & (data.q.numpy() <= robot.limits[:, 1])).all()
    found = held_out(robot, data, 6)
    assert found["nominal position"] == pytest.approx(0.71e-3, abs=0.03e-3)
    assert found["calibrated position"] < 0.23e-3


def test_fanuc_configurations_dealt_in_turn(shared_data: Path) -> None:
    """The folds that scikit-learn's GroupKFold makes: configuration k of the file is in fold k mod 6."""
    data, robot = (
        Measurements.read_csv(shared_data / "fanuc_r2000" / "positions.csv"),
        Robot.load("fanuc_r2000"),
    )
    errors = [
        GeometricCalibrator(robot).fit(data.select(train)).errors_of(data.select(test))["position"]
        for train, test in k_folds(data, 6, seed=0, by="interleaved")
    ]
    found = float(torch.cat(errors).square().sum(-1).mean().sqrt())
    assert found < 0.23e-3
    assert found == pytest.approx(0.2205e-3, abs=0.0005e-3)
