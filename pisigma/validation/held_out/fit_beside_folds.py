"""The calibration of all rows and those of its cross-validation, side by side where processes are asked for."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from pisigma.files.progress import Progress, silent, stage
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import TrainTest
from pisigma.validation.held_out.calibration_validation import JudgedFold, fold_tasks, judged_folds
from pisigma.validation.held_out.few_rows import fit_where_it_helps
from pisigma.validation.held_out.side_by_side import in_processes
from pisigma.validation.held_out.trained_calibrations import Calibrator, Result


def fit_beside_folds(
    calibrator: Calibrator,
    rows: Measurements,
    training: Measurements,
    repeats: Sequence[Sequence[TrainTest]],
    progress: Progress,
    jobs: int | None,
) -> tuple[Result, Iterator[JudgedFold]]:
    """Calibrate, and begin a cross-validation.

    Args:
        calibrator: of either kind.
        rows: to calibrate with.
        training: rows of the cross-validation.
        repeats: training and test rows of every fold, per repeat; none for no cross-validation.
        progress: called with what is being done, but for what other processes do.
        jobs: processes that share the calibration and the folds, with one thread each; None for threads of this one.

    Returns:
        The calibration, see `fit_where_it_helps`, and the folds for `joined_repeats`.

    Raises:
        IdentificationError: the rows do not determine what is asked for; those of a fold say so when it is taken.
        MemoryError: a process ended twice with the calibration or a fold.
    """
    validating = stage(progress, "cross-validation")
    if jobs is None or not repeats:
        result = fit_where_it_helps(calibrator, rows, stage(progress, "calibration"))
        return result, judged_folds(calibrator, training, repeats, validating)
    folds = fold_tasks(calibrator, training, repeats, silent)
    progress(f"calibration and {len(folds)} folds in {jobs} processes")
    fitting = partial(fit_where_it_helps, calibrator, rows, silent)
    results: Iterator[Any] = in_processes([fitting, *folds], jobs)  # a calibration, and then folds
    return next(results), results
