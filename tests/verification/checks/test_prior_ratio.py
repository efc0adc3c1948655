"""Errors that are far larger than the prior says are named, those of healthy robots are not."""

import pytest
from testing.checked import kinds_of
from testing.simulated_arm import simulate

from pisigma.identification.calibrator import GeometricCalibrator


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
    ratios = [
        one for one in kinds_of(GeometricCalibrator(arm.nominal), arm.measurements) if one[0] == "prior_ratio"
    ]
    assert ratios == ([] if severity is None else [("prior_ratio", severity)])
