"""Warnings for calibrations by cameras: views, intrinsics, the tool, and what limits the accuracy."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell

from pisigma.calibration.frames.shared_objects import uncertainty_of
from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS, Camera
from pisigma.measurement.camera.camera_files import IntrinsicsChoice, Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.model.stored_starts import nearest_branch
from pisigma.robot import Robot
from pisigma.robot.kinematics.closed_form import closed_form_solver
from pisigma.validation.checks.camera import check_camera
from pisigma.validation.checks.check import CheckedCalibration
from pisigma.validation.held_out.diagnostic import Diagnostic

CALIBRATOR = GeometricCalibrator(
    Robot.load("ur5"), prior=Prior(theta=5e-3, d=1e-3, a=1e-3, alpha=5e-3, beta=5e-3)
)
TOOL, LIMIT = "tool_not_identified", "camera_limits"
FRONTAL, BRANCH = "frontal_views", "one_branch"
FIXED, FREE, CONTRADICTED = "intrinsics_fixed", "intrinsics_free", "intrinsics_contradicted"


@cache
def calibrated(
    camera: Camera = CAMERA, intrinsics: IntrinsicsChoice = "prior"
) -> tuple[Measurements, CalibrationResult]:
    """The images of a UR5, and its calibration."""
    images = camera_cell(50, 1).images
    rows = image_measurements(images, camera, BOARD, False, Repeatability(), intrinsics)
    return rows, CALIBRATOR.fit(rows)


def found(checked: Measurements, result: CalibrationResult) -> dict[str, Diagnostic]:
    """Findings of the check for some of the rows of a calibration, by cause."""
    check = CheckedCalibration(CALIBRATOR, checked, {"geometric": result})
    return {one.cause: one for one in check_camera(check)}


@pytest.mark.parametrize(
    ("camera", "intrinsics", "expected"),
    [
        (CAMERA, "prior", {TOOL, LIMIT}),
        (CAMERA, "fixed", {TOOL, LIMIT, FIXED}),
        (CAMERA, "free", {TOOL, LIMIT, FREE}),
        (
            CAMERA.with_intrinsics(CAMERA.intrinsics + 8 * np.array(USUAL_DEVIATIONS)),
            "prior",
            {TOOL, LIMIT, CONTRADICTED},
        ),
    ],
)
def test_weaknesses_of_a_calibration_are_reported(
    camera: Camera, intrinsics: IntrinsicsChoice, expected: set[str]
) -> None:
    reported = found(*calibrated(camera, intrinsics))
    assert set(reported) == expected
    assert (reported[LIMIT].values.get("share_intrinsics", 0.0) >= 0.1) == (intrinsics != "fixed")


def test_the_predicted_error_includes_base_and_tool() -> None:
    rows, result = calibrated()
    q = 6.28 * torch.rand(200, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 3.14
    sigma = uncertainty_of(result).sigma(
        Measurements(q=q, frame=rows.frame[:1] * 200, target=rows.target[:1] * 200)
    )
    rms = float(sigma.square().sum(1).mean().sqrt())
    assert found(rows, result)[LIMIT].values["predicted_mm"] == pytest.approx(1e3 * rms, rel=0.1)


def test_frontal_views_and_a_single_branch_are_named() -> None:
    (rows, result), solver = calibrated(), closed_form_solver(CALIBRATOR.robot)
    assert solver is not None
    tilt = rows.T[:, 2, 2].abs().arccos()
    assert FRONTAL in found(rows.select(tilt < np.deg2rad(12)), result)
    branch = nearest_branch(solver, rows.q)
    assert BRANCH in found(rows.select(branch == torch.bincount(branch).argmax()), result)


def test_rows_without_images_have_no_findings() -> None:
    rows, result = calibrated()
    assert not found(replace(rows, rotation=None, readings={}), result)
