"""Calibrations as inputs of the checks."""

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.checks.registry import diagnostics_of
from pisigma.validation.held_out.trained_calibrations import (
    Calibrator,
    fit_compared_calibrations,
    geometric_of,
)


def checked(calibrator: Calibrator, rows: Measurements) -> CheckedCalibration:
    """Calibrate, and return the input of the checks."""
    return CheckedCalibration(geometric_of(calibrator), rows, fit_compared_calibrations(calibrator, rows))


def kinds_of(calibrator: GeometricCalibrator, rows: Measurements) -> list[tuple[str, str]]:
    """Return kind and severity of all diagnostics of a calibration."""
    return [(one.kind, one.severity) for one in diagnostics_of(checked(calibrator, rows))]
