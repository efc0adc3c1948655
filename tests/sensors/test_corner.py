"""Derivatives of the poses that images give."""

from pathlib import Path

import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell
from testing.closeness import assert_close
from torch import Tensor

from pisigma.camera.image_rows import Repeatability, image_measurements
from pisigma.errors import MeasurementError
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.measurement.dataset import Measurements


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


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("0.1,1 2 3", "a noise and 21 weights with blanks between were wanted, got '1 2 3'"),
        (f",{' '.join(['1'] * 21)}", "a noise and 21 weights with blanks between were wanted"),
        (f"-0.1,{' '.join(['1'] * 21)}", r"a positive noise was wanted, got -0\.1 mm"),
    ],
)
def test_faulty_weights_are_named(tmp_path: Path, cells: str, message: str) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(
        "q1_deg,x_mm,y_mm,z_mm,qx,qy,qz,qw,corner_noise_mm,corner_weight\n" + f"1,1,2,3,0,0,0,1,{cells}\n"
    )
    with pytest.raises(MeasurementError, match=message):
        Measurements.read_csv(path)
