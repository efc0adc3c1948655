"""Calibrations as checks see them."""

from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.judging.trained_calibrations import trained
from pisigma.measurement.dataset import Measurements
from pisigma.verification.checks.check import CheckedCalibration
from pisigma.verification.checks.registry import diagnostics_of


def checked(calibrator: GeometricCalibrator, rows: Measurements) -> CheckedCalibration:
    """Calibrate, and give what checks look at."""
    return CheckedCalibration(calibrator, rows, trained(calibrator, rows))


def kinds_of(calibrator: GeometricCalibrator, rows: Measurements) -> list[tuple[str, str]]:
    """Kind and severity of all that the checks say of a calibration."""
    return [(one.kind, one.severity) for one in diagnostics_of(checked(calibrator, rows))]
