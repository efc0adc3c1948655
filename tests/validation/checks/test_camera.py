"""What is said of calibrations by cameras: their views, their intrinsics, the tool, and what limits them."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell

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
from pisigma.validation.checks.camera import CameraCheck
from pisigma.validation.checks.check import CheckedCalibration

CALIBRATOR = GeometricCalibrator(
    Robot.load("ur5"), prior=Prior(theta=5e-3, d=1e-3, a=1e-3, alpha=5e-3, beta=5e-3)
)
TOOL, LIMIT = "cannot be distinguished from errors of the last joint's row", "is what limits"
FRONTAL, BRANCH = "less than", "on one branch"
HELD, FREE, CONTRADICTED = "were held", "were free", "contradict the calibration"


@cache
def calibrated(
    camera: Camera = CAMERA, intrinsics: IntrinsicsChoice = "prior"
) -> tuple[Measurements, CalibrationResult]:
    """The images of a UR5, and its calibration."""
    images = camera_cell(50, 1).images
    rows = image_measurements(images, camera, BOARD, False, Repeatability(), intrinsics)
    return rows, CALIBRATOR.fit(rows)


def sentences(checked: Measurements, result: CalibrationResult) -> str:
    """What the check says of some of the rows that were calibrated with."""
    check = CheckedCalibration(CALIBRATOR, checked, {"geometric": result})
    return " ".join(one.sentence for one in CameraCheck().diagnose(check))


@pytest.mark.parametrize(
    ("camera", "intrinsics", "said"),
    [
        (CAMERA, "prior", {TOOL, LIMIT}),
        (CAMERA, "fixed", {TOOL, LIMIT, HELD}),
        (CAMERA, "free", {TOOL, LIMIT, FREE}),
        (
            CAMERA.with_intrinsics(CAMERA.intrinsics + 8 * np.array(USUAL_DEVIATIONS)),
            "prior",
            {TOOL, LIMIT, CONTRADICTED},
        ),
    ],
)
def test_what_applies_is_said(camera: Camera, intrinsics: IntrinsicsChoice, said: set[str]) -> None:
    text = sentences(*calibrated(camera, intrinsics))
    everything = {TOOL, LIMIT, FRONTAL, BRANCH, HELD, FREE, CONTRADICTED}
    assert {one for one in everything if one in text} == said
    assert ("of its square from the intrinsics" in text) == (intrinsics != "fixed")


def test_frontal_views_and_a_single_branch_are_named() -> None:
    (rows, result), solver = calibrated(), closed_form_solver(CALIBRATOR.robot)
    assert solver is not None
    tilt = rows.T[:, 2, 2].abs().arccos()
    assert FRONTAL in sentences(rows.select(tilt < np.deg2rad(12)), result)
    branch = nearest_branch(solver, rows.q)
    assert BRANCH in sentences(rows.select(branch == torch.bincount(branch).argmax()), result)


def test_other_sensors_are_no_matter_of_cameras() -> None:
    rows, result = calibrated()
    assert not sentences(replace(rows, rotation=None, readings={}), result)
