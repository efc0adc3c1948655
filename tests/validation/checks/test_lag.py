"""Joint values that were logged too early or too late are found, and others are left alone."""

import numpy as np
import pytest
import torch
from testing.checked import checked
from testing.closeness import assert_close
from testing.outside_arm import ARMS, OutsideArm

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.validation.checks.lag import check_lag, find_lag
from pisigma.validation.setup_faults.ordered_rows import OrderedRows

SHARE = 2e-3


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("before", [True, False])
def test_a_lag_is_found_with_its_size(name, before):
    arm = OutsideArm(name, 3)
    other = np.roll(arm.q, 1 if before else -1, axis=0)
    other[0 if before else -1] = arm.q[0 if before else -1]
    rows = arm.measured(logged=arm.q - SHARE * (arm.q - other))
    check = checked(GeometricCalibrator(arm.robot), rows)
    (found,) = check_lag(check)
    assert (found.kind, found.severity) == ("lag", "implausible")
    lag = find_lag(OrderedRows.from_result(check.geometric), rows)
    assert lag.logged_before_arrival == before
    assert_close(lag.share_of_motion, SHARE, rtol=0.15)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("seed", range(5, 8))
def test_rows_without_a_lag_are_accepted(name, seed):
    arm = OutsideArm(name, seed, 60, seed)
    assert list(check_lag(checked(GeometricCalibrator(arm.robot), arm.measured()))) == []


@pytest.mark.parametrize(("name", "file"), [("ur5", "ur5/grid.csv"), ("ur10", "ur10/series_b.csv")])
def test_measured_robots_have_none(shared_data, name, file):
    robot = Robot.load(name)
    rows = Measurements.read_csv(shared_data / file, robot).select(torch.arange(0, 900, 2))
    assert list(check_lag(checked(GeometricCalibrator(robot), rows))) == []
