"""Models and measurements for tests of reports."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from testing.hybrid import NOISE, HybridArmUnderTest, hybrid_of, joints_in
from testing.models import no_type_checker

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.observability import Observability
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.files.model_files import CORRELATION_CSV, HELD_OUT_CSV
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.folder.model_folder import save_model
from pisigma.model.geometric_model import model_of_calibration, model_of_hybrid
from pisigma.reporting.calibration_tables import write_correlations
from pisigma.validation.held_out.calibration_summary import (
    CalibrationSummary,
    RedundancyFigures,
    summarise,
)
from pisigma.validation.held_out.calibration_validation import CalibrationValidation, judge
from pisigma.validation.held_out.held_out_rows import HeldOutRows

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'&\u2028$x_1$"
"""A name that breaks pages that do not escape it."""


def measured(arm: HybridArmUnderTest, rows: int, seed: int) -> Measurements:
    """Return other rows of a simulated robot, with the noise of its calibration."""
    q = joints_in(arm.true.nominal, rows, seed)
    noise = NOISE * torch.from_numpy(np.random.default_rng(seed).normal(size=(rows, 3)))
    return Measurements(q=q, position=arm.true.forward(q)[:, :3, 3] + noise)


@functools.cache
def hybrid_under_test(frames: bool = False) -> tuple[HybridArmUnderTest, CalibratedModel]:
    """Return a simulated arm, and its model with all metrics, tested on other rows."""
    arm = hybrid_of("rb5", 200, frames=frames)
    with no_type_checker():
        summary = summarise(arm.result).with_figures(rows=200)
        if not frames:
            summary = summary.with_figures(cross_validation=evaluated_on(arm, measured(arm, 60, 5)).figures())
        model = model_of_hybrid("arm", arm.true.nominal, arm.result, arm.measurements)
    return arm, replace(model, metrics=summary.to_json())


def evaluated_on(arm: HybridArmUnderTest, rows: Measurements) -> CalibrationValidation:
    """Evaluate the calibration of an arm on rows."""
    calibrator = HybridCalibrator(GeometricCalibrator(arm.true.nominal))
    return judge(calibrator, arm.result, arm.measurements, rows)


@functools.cache
def geometric_under_test() -> tuple[HybridArmUnderTest, CalibratedModel]:
    """Return the same arm, and its geometric calibration."""
    arm = hybrid_of("rb5", 200)
    with no_type_checker():
        result = arm.result.geometric
        model = model_of_calibration("plain", arm.true.nominal, result, arm.measurements)
        return arm, replace(model, metrics=summarise(result).with_figures(rows=200).to_json())


def folder_with_held_out(arm: HybridArmUnderTest, model: CalibratedModel, folder: Path) -> CalibratedModel:
    """Write a model folder with errors of "held-out" rows: those of the calibration, enlarged by a tenth."""
    with no_type_checker():
        found = evaluated_on(arm, arm.measurements)
        for errors in found.errors_by_model.values():
            errors.position.mul_(1.1)
        held_out = HeldOutRows.from_validation(found, arm.measurements)
        text = held_out.to_csv(model.robot)
        summary = CalibrationSummary.read(model).with_figures(held_out_rows=held_out.compute_hashes(text))
        model = replace(model, metrics=summary.to_json())
        folder.mkdir()
        save_model(model, folder)
        (folder / HELD_OUT_CSV).write_text(text, encoding="utf-8", newline="\n")
        pairwise = arm.result.geometric.pairwise_redundancy
        write_correlations((pairwise.lengths, pairwise.angles), folder / CORRELATION_CSV)
    return model


def bare_summary(**figures: object) -> CalibrationSummary:
    """Return the figures of a calibration without findings, and given ones."""
    return CalibrationSummary(
        status="converged",
        iterations=1,
        rank=0,
        condition_number=None,
        observability=Observability(O1=0.0, O2=0.0, O3=0.0, O4=0.0, O5=0.0),
        noise=(),
        parameters=(),
        redundancy=RedundancyFigures(
            kept=(), removed=(), no_effect=(), dependencies=(), pairwise_sets=(), pairwise_kept=()
        ),
        weak_directions=(),
        outliers=(),
        warnings=(),
        rmse_mm=(),
    ).with_figures(**figures)
