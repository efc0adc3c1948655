"""Calibrations of few rows: the arm stays nominal unless a fitted arm predicts held-out rows better.

A calibration and those of its cross-validation can run in parallel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from scipy.special import fdtrc

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.sufficiency import distinct_rows, distinct_values
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.engines.processes import run_in_processes
from pisigma.files.errors import IdentificationError, MeasurementError
from pisigma.files.progress import Progress, no_progress, with_stage
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import TrainTest, k_folds
from pisigma.validation.held_out.calibration_validation import JudgedFold, fold_tasks, judged_folds, validate
from pisigma.validation.held_out.trained_calibrations import (
    Calibrator,
    Result,
    base_and_tool_calibrator,
    fit,
    geometric_of,
    geometric_result,
)

_MIN_RATIO = 2.0
"""Measured values per parameter below which rows are few: the noise, and with it the prior scale, is then estimated
from fewer than half of the values."""
_MIN_RATIO_HELD_OUT = 1.25
"""Values per parameter below which held-out rows cannot decide, because a fit that omits a pose has hardly more values
than parameters; an F test of the residuals of all rows decides instead."""
_CHANCE = 1e-4
"""Significance level of this test. With 10 random positions of the measured UR10 and 11 of the UR5, the fitted arms
that pass predict other rows with 0.6 and 0.25 times the error of the nominal arm (medians of 27 and 14 draws; the worst
draw has 1.4 times the error)."""
_MIN_POSES = 10
"""Smallest number of poses that can decide, even with orientations: 6 poses of the UR10 would give 0.6 to 2.4 times the
error."""
_USED_UP = 0.9
"""Share of the values of a sensor used up by the parameters above which its noise is not determined."""


def fit_if_better(calibrator: Calibrator, rows: Measurements, progress: Progress) -> Result:
    """Calibrate; with few rows, the fitted arm is kept only if it proves better than the nominal one.

    Args:
        calibrator: a calibrator of either kind.
        rows: the rows to calibrate with.
        progress: called with the current step.

    Returns:
        The calibration, or else the nominal arm with base and tool fitted.

    Raises:
        IdentificationError: see the calibrators' `fit`.
    """
    result = fit(calibrator, rows, progress)
    geometric = geometric_of(calibrator)
    if not geometric.free or _helps(
        geometric, geometric_result(result), rows, with_stage(progress, "few rows")
    ):
        return result
    nominal = base_and_tool_calibrator(geometric)
    if isinstance(calibrator, HybridCalibrator):
        return fit(replace(calibrator, robot=nominal, features=(), products=False), rows, progress)
    return fit(nominal, rows, progress)


def _helps(
    calibrator: GeometricCalibrator, result: CalibrationResult, rows: Measurements, progress: Progress
) -> bool:
    """Return whether there are enough values per parameter, or if not, whether a fit predicts held-out poses better."""
    ratio = distinct_values(result.solved.problem) / max(result.solved.findings.estimated_count, 1)
    if ratio >= _MIN_RATIO:
        return True
    if any(noise.effective_parameters > _USED_UP * noise.values for noise in result.noise):
        return False
    if ratio < _MIN_RATIO_HELD_OUT:
        return distinct_rows(result.solved.problem) >= _MIN_POSES and _evident(calibrator, result, rows)
    try:
        errors = validate(calibrator, rows, k_folds(rows, None, seed=0), progress).errors_by_model
    except (IdentificationError, MeasurementError):  # with one pose left out, nothing can be fitted
        return False
    nominal, fitted = (errors[name].position.square().nanmean() for name in ("nominal", "geometric"))
    return not bool(fitted >= nominal)


def _evident(calibrator: GeometricCalibrator, result: CalibrationResult, rows: Measurements) -> bool:
    """Return whether the residuals of the fitted arm are significantly smaller than those of the nominal one.

    This is the F test of nested models, with the effective number of parameters under their prior.
    """
    nominal = base_and_tool_calibrator(calibrator).fit(rows).noise
    pairs = list(zip(result.noise, nominal, strict=True))
    left = sum(noise.values - noise.effective_parameters for noise, _ in pairs)
    more = sum(noise.effective_parameters - before.effective_parameters for noise, before in pairs)
    before = sum(
        (one.values - one.effective_parameters) * (one.sigma / noise.sigma) ** 2 for noise, one in pairs
    )
    return more > 0 and bool(fdtrc(more, left, (before - left) / more) < _CHANCE)


def fit_with_folds(
    calibrator: Calibrator,
    rows: Measurements,
    training: Measurements,
    repeats: Sequence[Sequence[TrainTest]],
    progress: Progress,
    jobs: int | None,
) -> tuple[Result, Iterator[JudgedFold]]:
    """Calibrate, and start a cross-validation.

    Args:
        calibrator: a calibrator of either kind.
        rows: the rows to calibrate with.
        training: rows of the cross-validation.
        repeats: training and test rows of every fold, per repeat; empty for no cross-validation.
        progress: callback that is called with the current step of this process.
        jobs: number of processes for the calibration and the folds, with one thread each; None for threads of this
            process.

    Returns:
        The calibration (see `fit_if_better`), and the folds for `joined_repeats`.

    Raises:
        IdentificationError: the rows do not determine the parameters; for a fold, the iterator raises it.
        MemoryError: a process with the calibration or a fold was killed twice.
    """
    validating = with_stage(progress, "cross-validation")
    if jobs is None or not repeats:
        result = fit_if_better(calibrator, rows, with_stage(progress, "calibration"))
        return result, judged_folds(calibrator, training, repeats, validating)
    folds = fold_tasks(calibrator, training, repeats, no_progress)
    progress(f"calibration and {len(folds)} folds in {jobs} processes")
    fitting = partial(fit_if_better, calibrator, rows, no_progress)
    results: Iterator[Any] = run_in_processes([fitting, *folds], jobs)  # a calibration, and then folds
    return next(results), results
