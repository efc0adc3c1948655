"""Derivatives of the poses that images give."""

import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell
from testing.closeness import assert_close
from torch import Tensor

from pisigma.camera.image_rows import Repeatability, image_measurements
from pisigma.identification.calibrator import GeometricCalibrator


def test_derivatives_are_those_of_the_weighted_errors() -> None:
    cell = camera_cell(8)
    data = image_measurements(cell.images, CAMERA, BOARD, False, Repeatability())
    setup = GeometricCalibrator(cell.nominal).build(data)
    problem, everything, rows = setup.problem, torch.arange(len(setup.start)), slice(0, 8)
    (sensor,) = problem.sensors

    def residual(at: Tensor) -> Tensor:
        return sensor.residual(problem.motion(at, rows, everything), {}, rows)

    J = problem.derivative(sensor, problem.motion(setup.start, rows, everything), {}, rows, everything)
    assert (
        float(residual(setup.start).norm(dim=0).min()) > 1e-3
    )  # the arm as drawn is far from what was measured
    for i in everything.tolist():
        step = torch.zeros_like(setup.start)
        step[i] = 1e-6
        change = (residual(setup.start - step) - residual(setup.start + step)) / 2e-6
        assert_close(J[i], change, atol=1e-6, rtol=1e-6)
