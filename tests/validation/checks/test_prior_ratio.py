"""Errors that are far larger than the prior says are named, those of healthy robots are not."""

from dataclasses import replace

import pytest
import torch
from testing.checked import kinds_of
from testing.hybrid import few_robots
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.validation.setup_faults.nominal_robot_faults import find_nominal_robot_faults

pytestmark = pytest.mark.usefixtures("without_type_checker")


@pytest.fixture(scope="module", autouse=True)
def few():
    """See `few_robots`; whether another robot was measured is tested in `test_measured_robots`."""
    with few_robots():
        yield


@pytest.mark.parametrize(
    ("length", "angle", "severity"),
    [
        (5e-4, 1e-3, None),
        (5e-4, 15e-3, "warning"),
        (5e-4, 60e-3, "implausible"),
        (40e-3, 1e-3, "implausible"),
    ],
)
def test_how_large_errors_are_taken(length, angle, severity):
    arm = simulate("ur10", rows=60, noise=5e-5, length=length, angle=angle)
    found = severities(GeometricCalibrator(arm.nominal), arm.measurements)
    assert min(found, default=None) == severity  # "implausible" is before "warning"


def test_zeros_that_are_far_off_are_believed_within_the_class():
    """The class that is not stated is found from the data; a stated one has its own limits."""
    arm = simulate("ur10", rows=40, noise=5e-5, length=5e-4, angle=5e-4, offset=50e-3)
    found, stated, narrow = (
        GeometricCalibrator(arm.nominal, robot_class=one) for one in (None, "hobby", "industrial")
    )
    assert severities(found, arm.measurements) == severities(stated, arm.measurements) == {"warning"}
    assert severities(narrow, arm.measurements) == {"implausible"}
    assert find_nominal_robot_faults(arm.nominal, arm.measurements) == ()


def test_zeros_that_are_far_off_are_not_believed_where_held_out_rows_are_not_predicted():
    arm = simulate("ur10", rows=40, noise=5e-5, length=5e-4, angle=5e-4, offset=50e-3)
    rows = arm.measurements
    scattered = rows.position + 0.02 * torch.randn(
        rows.position.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    rows = replace(rows, position=scattered)
    assert severities(GeometricCalibrator(arm.nominal), rows) == {"implausible"}


def severities(calibrator, rows):
    return {severity for kind, severity in kinds_of(calibrator, rows) if kind == "prior_ratio"}
