"""Projection, its derivative and inverse, and camera files of three kinds."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from testing.camera_cell import CAMERA
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.camera import Camera

OWN = "width: 1920\nheight: 1200\nfx: 1400\nfy: 1401.5\ncx: 960\ncy: 600\nk1: -0.1\nk3: 0.01\n"
ROS = """image_width: 1920
image_height: 1200
camera_name: camera
camera_matrix: {rows: 3, cols: 3, data: [1400, 0, 960, 0, 1401.5, 600, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0, 0, 0, 0.01]}
projection_matrix: {rows: 3, cols: 4, data: [1400, 0, 960, 0, 0, 1400, 600, 0, 0, 0, 1, 0]}
"""
OPENCV = """%YAML:1.0
---
calibration_time: "Sun 22 Nov 2026"
image_width: 1920
image_height: 1200
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1400., 0., 960., 0., 1.4015e+03, 600., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -1.0e-01, 0., 0., 0., 1.0e-02 ]
"""


def points() -> np.ndarray:
    """Return points in front of a camera [m]."""
    return np.random.default_rng(0).uniform((-0.2, -0.15, 0.4), (0.2, 0.15, 0.9), (5, 4, 3))


def test_the_derivative_is_that_of_the_pixels() -> None:
    at, step = points(), 1e-6 * np.eye(3)
    pixels, derivative = CAMERA.project(at)
    assert pixels.shape == (5, 4, 2)
    for k in range(3):
        change = (CAMERA.project(at + step[k])[0] - CAMERA.project(at - step[k])[0]) / 2e-6
        assert_close(derivative[..., k], change, atol=1e-4, rtol=1e-7)


def test_the_derivative_by_the_intrinsics_is_that_of_the_pixels() -> None:
    at = points()
    derivative = CAMERA.intrinsics_jacobian(at)
    assert derivative.shape == (5, 4, 2, 9)
    for k, step in enumerate(1e-6 * np.eye(9)):
        more, less = (CAMERA.with_intrinsics(CAMERA.intrinsics + change) for change in (step, -step))
        change = (more.project(at)[0] - less.project(at)[0]) / 2e-6
        assert_close(derivative[..., k], change, atol=1e-4, rtol=1e-7)


def test_undistorted_pixels_are_the_rays_of_their_points() -> None:
    at = points()
    assert_close(CAMERA.undistort(CAMERA.project(at)[0]), at[..., :2] / at[..., 2:], atol=1e-12)


@pytest.mark.parametrize("text", [OWN, ROS, OPENCV], ids=["own", "ros", "opencv"])
def test_one_camera_in_three_kinds_of_files(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    wanted = Camera("camera", 1920, 1200, 1400.0, 1401.5, 960.0, 600.0, k1=-0.1, k3=0.01)
    assert Camera.load(path) == wanted


def test_deviations_of_the_intrinsics_are_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(OWN + "sigma: {fx: 0.5, fy: 0.6, cx: 1, k1: 0.002}\n")
    camera = Camera.load(path)
    assert camera.sigma == (0.5, 0.6, 1.0, 0.0, 0.002, 0.0, 0.0, 0.0, 0.0)
    fixed = replace(camera, is_fixed=True)
    path.write_text(fixed.to_yaml())
    assert Camera.load(path) == fixed


@pytest.mark.parametrize(
    ("text", "line", "column", "value"),
    [
        (OWN.replace("fx", "f_x"), 3, "f_x", "f_x"),
        (OWN + "sigma: {fx: -1}\n", 9, "sigma", None),
        (OWN.replace("fx: 1400", "fx: -1400"), 3, "fx", -1400),
        (ROS.replace("plumb_bob", "equidistant"), 5, "distortion_model", "equidistant"),
        (OPENCV.replace("image_width", "fisheye_model: 1\nimage_width"), 4, "fisheye_model", 1),
        (ROS + "binning_x: 2\n", 8, "binning_x", 2),
        (
            ROS.replace("0.01]", "0.01, 3]"),
            None,
            "distortion_coefficients.data",
            (-0.1, 0.0, 0.0, 0.0, 0.01, 3.0),
        ),
        (
            ROS.replace("[1400, 0, 960", "[1400, 2, 960"),
            None,
            "camera_matrix.data",
            (1400.0, 2.0, 960.0, 0.0, 1401.5, 600.0, 0.0, 0.0, 1.0),
        ),
    ],
)
def test_faulty_files_are_refused(
    tmp_path: Path, text: str, line: int | None, column: str, value: object
) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with refused(MeasurementError, file=path, line=line, column=column, value=value):
        Camera.load(path)
