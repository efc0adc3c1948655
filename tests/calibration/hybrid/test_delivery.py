"""A joint correction is delivered only where it serves every sensor."""

from pathlib import Path

import pytest
import torch
from testing.models import no_type_checker

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.delivery import EXACT_GROUPS, SensorErrors
from pisigma.calibration.hybrid.result import HybridResult
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot


def socket_rms(result: HybridResult | CalibrationResult, rows: Measurements) -> float:
    return float(result.errors_of(rows)["socket"].square().sum(1).mean().sqrt()) * 1e3


@pytest.mark.parametrize("distances", [{("C/1", "C/2"): 0.03996}, {("A/0", "A/1"): 0.0399}])
def test_a_correction_fits_sockets_no_worse_than_the_geometry(shared_data: Path, distances):
    """An FR3 on three plates of sockets, without any other sensor: 0.66 mm against 0.39 before."""
    folder = shared_data / "holiday"
    robot = Robot.load(str(folder / "fr3.urdf"), tip="ball_link")
    rows = Measurements.read_csv(folder / "fr3_sockets.csv")
    with no_type_checker():
        result = HybridCalibrator(GeometricCalibrator(robot, socket_distances=distances)).fit(rows)
    geometric = socket_rms(result.geometric, rows)
    assert geometric < 0.5
    assert socket_rms(result, rows) < 1.005 * geometric
    assert rows.rows <= EXACT_GROUPS


def test_errors_of_a_sensor_are_compared_by_groups():
    group = torch.arange(50) // 2
    small = 1e-4 * torch.rand(50, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    before = SensorErrors(group, 2 * small, 3 * small, torch.ones_like(small))
    better = SensorErrors(group, small, small, torch.ones_like(small))
    assert not better.compare(before).is_worse
    assert better.compare(before).held_out_ratio == pytest.approx(1 / 3)
    assert better.compare(before).gain_in_standard_errors > 3
    assert before.compare(better).is_worse
    assert before.compare(better).gain_in_standard_errors < -3
    fitted_better = SensorErrors(group, small, 4 * small, torch.ones_like(small))
    assert fitted_better.compare(before).is_worse
