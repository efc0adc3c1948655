"""A search that was stopped is no calibration."""

from testing.checked import kinds_of
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator


def test_a_search_stopped_at_its_limit_is_implausible():
    arm = simulate("ur10", rows=40, noise=5e-5)
    stopped = GeometricCalibrator(arm.nominal, maximum_iterations=4)
    assert ("search", "implausible") in kinds_of(stopped, arm.measurements)
    assert kinds_of(GeometricCalibrator(arm.nominal), arm.measurements) == []
