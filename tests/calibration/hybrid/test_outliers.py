"""Outliers are judged against the hybrid: what the geometry does not explain is not for that reason wrong."""

from dataclasses import replace

import torch
from testing.linearised import random_joints, tracker_data
from testing.models import no_type_checker
from torch import Tensor

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

ROBOT = Robot.load("rb5")
WRONG = range(3, 178, 7)


def local_error(q: Tensor) -> Tensor:
    """A gear that is off by 2 mrad over a narrow range of the second joint, and nowhere else."""
    delta = torch.zeros_like(q)
    delta[:, 1] = 2e-3 * torch.exp(-(((q[:, 1] - 1.0) / 0.35) ** 2))
    return delta


def rms(result: HybridResult, test: Measurements) -> float:
    return float(result.errors_of(test)["position"].square().sum(1).mean().sqrt())


def test_rows_that_a_joint_correction_explains_are_no_outliers() -> None:
    """One row in eight is off by about 30 mm besides; none of the others is taken for wrong, none of those for good."""
    q = random_joints(ROBOT, 200, 0)
    rows = tracker_data(ROBOT, q, local_error(q), 3e-5)
    assert rows.position is not None
    position = rows.position.clone()
    position[WRONG] += 3e-2 * torch.randn(
        (len(WRONG), 3), generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    with no_type_checker():
        result = HybridCalibrator(ROBOT, harmonics=(8, 24, 56), products=False).fit(
            replace(rows, position=position)
        )
    assert len(result.geometric.outliers) > len(WRONG) + 5
    assert {outlier.row for outlier in result.outliers} == set(WRONG)
    q = random_joints(ROBOT, 300, 5)
    test = tracker_data(ROBOT, q, local_error(q))
    assert rms(result, test) < 0.3 * rms(HybridCalibrator(ROBOT, features=(), products=False).fit(rows), test)
