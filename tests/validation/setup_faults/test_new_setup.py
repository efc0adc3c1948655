"""Rows of two setups in one file are recognised with the nominal robot."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements, with_new_frames
from pisigma.robot import Robot
from pisigma.robot.se3 import transform_from_xyz_zyx
from pisigma.validation.checks.row_order import instrument_moved_error
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

ELSEWHERE = transform_from_xyz_zyx(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.1, -0.2], dtype=torch.float64))
ROWS = 60


def two_setups(first: int, wrong: float = 0.0) -> tuple[Robot, Measurements]:
    """A robot and its measurements as read from a file."""
    arm = simulate("ur5", rows=ROWS, noise=5e-5, wrong=wrong)
    assert arm.measurements.position is not None
    position = arm.measurements.position.clone()
    position[first:] = position[first:] @ ELSEWHERE[:3, :3].T + ELSEWHERE[:3, 3]
    lines = tuple(range(2, 2 + ROWS))
    return arm.nominal, replace(arm.measurements, position=position, line=lines, source="tracker.csv")


@pytest.mark.parametrize(("first", "wrong"), [(15, 0.05), (30, 0.0), (45, 0.05)])
def test_the_first_row_after_the_instrument_was_moved_is_named(first: int, wrong: float) -> None:
    problem = instrument_moved_error(*two_setups(first, wrong))
    assert problem is not None
    assert (problem.file, problem.line) == ("tracker.csv", first + 2)


def test_a_refusal_names_the_line_and_a_new_frame_there_helps() -> None:
    robot, rows = two_setups(30)
    settings = CalibrationSettings(model="geometric", folds=0)
    with refused(IdentificationError, file="tracker.csv", line=32):
        calibrate(robot, rows, settings)
    apart = with_new_frames(rows, [32])
    assert_close(GeometricCalibrator(robot).fit(apart).noise[0].sigma, 5e-5, rtol=0.3)


def test_rows_that_fit_no_setup_are_not_a_new_setup() -> None:
    arm = simulate("ur5", rows=ROWS, noise=5e-5)
    assert arm.measurements.position is not None
    assert instrument_moved_error(arm.nominal, arm.measurements) is None
    shuffled = arm.measurements.position[torch.randperm(ROWS, generator=torch.Generator().manual_seed(0))]
    assert instrument_moved_error(arm.nominal, replace(arm.measurements, position=shuffled)) is None
