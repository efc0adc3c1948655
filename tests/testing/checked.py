"""Calibrations as checks see them."""

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.registry import diagnostics_of
from pisigma.validation.held_out.trained_calibrations import trained


def checked(calibrator: GeometricCalibrator, rows: Measurements) -> CheckedCalibration:
    """Calibrate, and give what checks look at."""
    return CheckedCalibration(calibrator, rows, trained(calibrator, rows))


def kinds_of(calibrator: GeometricCalibrator, rows: Measurements) -> list[tuple[str, str]]:
    """Kind and severity of all that the checks say of a calibration."""
    return [(one.kind, one.severity) for one in diagnostics_of(checked(calibrator, rows))]
