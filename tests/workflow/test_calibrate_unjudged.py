"""A calibration without held-out rows predicts its errors."""

import pytest
import torch
from testing.simulated_arm import simulate

from pisigma.validation.held_out.calibration_validation import pose_errors_of
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.settings.calibration import CalibrationSettings


@pytest.mark.parametrize("model", ["geometric", "hybrid"])
def test_a_calibration_without_held_out_rows_predicts_its_error_at_other_poses(model):
    arm = simulate("ur5", rows=220, noise=5e-5)
    few, others = (arm.measurements.select(torch.arange(*part)) for part in ((0, 20), (20, 220)))
    calibration = calibrate(arm.nominal, few, CalibrationSettings(model=model, folds=0))
    predicted, fitted = calibration.summary.predicted_rms_mm, calibration.summary.training_errors
    assert predicted is not None
    assert fitted is not None
    error = float(pose_errors_of(calibration.result, others).position.square().mean().sqrt()) * 1e3
    assert error / 1.7 < predicted < 1.7 * error
    assert predicted > 1.5 * fitted.models[model].rms_mm


def test_with_held_out_rows_no_error_is_predicted():
    arm = simulate("ur5", rows=40, noise=5e-5)
    settings = CalibrationSettings(model="geometric", hold_out=0.3)
    assert calibrate(arm.nominal, arm.measurements, settings).summary.predicted_rms_mm is None
