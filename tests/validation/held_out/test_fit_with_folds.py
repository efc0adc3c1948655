"""A calibration of all rows together with those of its folds, in this process and in several processes."""

import torch
from testing.simulated_arm import simulate

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.progress import no_progress
from pisigma.measurement.splits import k_folds
from pisigma.validation.held_out.calibration_validation import joined_repeats
from pisigma.validation.held_out.few_rows import fit_with_folds


def test_processes_give_the_same_to_the_bit() -> None:
    arm = simulate("kiro4", rows=24, noise=5e-5)
    rows, calibrator = arm.measurements, HybridCalibrator(arm.nominal, harmonics=(8,), products=False)
    repeats = [k_folds(rows, 3, 0)]
    (here, judged), (there, judged_there) = (
        fit_with_folds(calibrator, rows, rows, repeats, no_progress, jobs) for jobs in (None, 1)
    )
    assert torch.equal(here.errors_of(rows)["position"], there.errors_of(rows)["position"])
    validation = joined_repeats(rows, repeats, judged_there)
    for name, errors in joined_repeats(rows, repeats, judged).errors_by_model.items():
        assert torch.equal(errors.position, validation.errors_by_model[name].position), name
