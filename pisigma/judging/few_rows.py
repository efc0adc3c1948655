"""Calibrations of few rows: the arm stays as drawn unless left-out rows are predicted better with a fitted one."""

from dataclasses import replace

from pisigma.errors import IdentificationError, MeasurementError
from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.identifiability.sufficiency import distinct_values
from pisigma.identification.result import CalibrationResult
from pisigma.judging.calibration_validation import validate
from pisigma.judging.progress import Progress, stage
from pisigma.judging.trained_calibrations import (
    Calibrator,
    Result,
    base_and_tool,
    fit,
    geometric_of,
    geometric_result,
)
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import k_folds

FEW = 2.0
"""Fewer measured values per parameter are few: the noise, and with it the size of the prior, is estimated from less
than half of them."""
TOO_FEW = 1.25
"""With fewer, left-out rows show nothing: a fit without a pose has hardly more values than parameters."""
USED_UP = 0.9
"""Share of the values of a sensor. Where the parameters use up more of them, its noise is not determined."""


def fit_where_it_helps(calibrator: Calibrator, rows: Measurements, progress: Progress) -> Result:
    """Calibrate; few rows have to show that the fitted arm is better than the drawn one.

    Args:
        calibrator: of either kind.
        rows: to calibrate with.
        progress: called with what is being done.

    Returns:
        The calibration; with few rows that do not show it, the drawn arm with base and tool fitted.

    Raises:
        IdentificationError: see the calibrators' `fit`.
    """
    result = fit(calibrator, rows, progress)
    geometric = geometric_of(calibrator)
    if not geometric.free or _helps(geometric, geometric_result(result), rows, stage(progress, "few rows")):
        return result
    drawn = base_and_tool(geometric)
    if isinstance(calibrator, HybridCalibrator):
        return fit(replace(calibrator, robot=drawn, features=(), products=False), rows, progress)
    return fit(drawn, rows, progress)


def _helps(
    calibrator: GeometricCalibrator, result: CalibrationResult, rows: Measurements, progress: Progress
) -> bool:
    """Whether there are enough values per parameter, or else poses are predicted better by fits to the others."""
    ratio = distinct_values(result.solved.problem) / max(result.solved.findings.wanted, 1)
    if ratio >= FEW:
        return True
    if ratio < TOO_FEW or any(noise.used > USED_UP * noise.values for noise in result.noise):
        return False
    try:
        errors = validate(calibrator, rows, k_folds(rows, None, seed=0), progress).models
    except (IdentificationError, MeasurementError):  # without a pose nothing can be fitted any more
        return False
    nominal, fitted = (errors[name].position.square().nanmean() for name in ("nominal", "geometric"))
    return not bool(fitted >= nominal)
