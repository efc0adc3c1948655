"""Derivatives of poses from images."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from testing.camera_cell import BOARD, CAMERA, camera_cell
from testing.closeness import assert_close
from testing.refusals import refused
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.files.errors import MeasurementError
from pisigma.measurement.camera.camera import USUAL_DEVIATIONS
from pisigma.measurement.camera.camera_files import Repeatability
from pisigma.measurement.camera.image_rows import image_measurements
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.sensors.corner import relative_position_sigmas
from pisigma.measurement.sensors.intrinsics import without_stated_priors


def test_derivatives_are_those_of_the_weighted_errors() -> None:
    cell = camera_cell(8)
    board = replace(BOARD, scale_sigma=1e-3)
    data = image_measurements(cell.images, CAMERA, board, False, Repeatability())
    setup = GeometricCalibrator(cell.nominal).build(data)
    problem, everything, rows = setup.problem, torch.arange(len(setup.start)), slice(0, 8)
    assert [sensor.name for sensor in problem.sensors] == ["corner", "intrinsics", "board scale"]
    unknowns = problem.space.sensor_unknowns

    def residuals(at: Tensor) -> list[Tensor]:
        motion = problem.motion(at, rows, everything)
        return [sensor.residual(motion, unknowns(at), rows) for sensor in problem.sensors]

    motion = problem.motion(setup.start, rows, everything)
    J = [
        problem.prediction_derivative(sensor, motion, unknowns(setup.start), rows, everything)
        for sensor in problem.sensors
    ]
    off = residuals(setup.start)[0].norm(dim=0)
    assert float(off.min()) > 1e-3  # the nominal arm is far from what was measured
    for i in everything.tolist():
        step = torch.zeros_like(setup.start)
        step[i] = 1e-6
        for derivative, less, more in zip(
            J, residuals(setup.start - step), residuals(setup.start + step), strict=True
        ):
            assert_close(derivative[i], (less - more) / 2e-6, atol=1e-6, rtol=1e-6)


def test_deviations_of_positions_are_those_of_their_covariance() -> None:
    data = image_measurements(camera_cell(8).images, CAMERA, BOARD, False, Repeatability())
    row, column = torch.tril_indices(6, 6)
    noise, texts = data.readings["corner_noise"], data.readings["corner_weight"]
    weight = torch.zeros(8, 6, 6, dtype=torch.float64)
    weight[:, row, column] = torch.tensor([[float(word) for word in text.split()] for text in texts]).double()
    covariance = torch.linalg.inv(weight.mT @ weight)[:, :3, :3].diagonal(dim1=1, dim2=2)
    deviation = relative_position_sigmas(data) * torch.as_tensor(noise)[:, None]
    assert_close(deviation, covariance.sqrt(), rtol=1e-4)
    assert float(deviation.min()) > 2e-5  # the repeatability
    tracker = Measurements(q=data.q, position=data.position)
    assert bool(relative_position_sigmas(tracker).isnan().all())


def test_positions_of_images_without_their_rotations_are_plain_positions() -> None:
    cell = camera_cell(20)
    data = image_measurements(cell.images, CAMERA, BOARD, False, Repeatability())
    problem = GeometricCalibrator(cell.nominal).build(replace(data, rotation=None)).problem
    assert [sensor.name for sensor in problem.sensors] == ["position"]


@pytest.mark.parametrize(
    ("cells", "column", "value"),
    [
        ("0.1,1 2 3", "corner_weight", "1 2 3"),
        (f",{' '.join(['1'] * 21)}", "corner_weight", " ".join(["1"] * 21)),
        (f"-0.1,{' '.join(['1'] * 21)}", "corner_noise_mm", -0.1),
    ],
)
def test_faulty_weights_are_refused(tmp_path: Path, cells: str, column: str, value: object) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(
        "q1_deg,x_mm,y_mm,z_mm,qx,qy,qz,qw,corner_noise_mm,corner_weight\n" + f"1,1,2,3,0,0,0,1,{cells}\n"
    )
    with refused(MeasurementError, line=2, column=column, value=value):
        Measurements.read_csv(path)


def test_priors_that_a_model_includes_are_not_counted_again() -> None:
    images = image_measurements(camera_cell(8).images, CAMERA, BOARD, False, Repeatability())
    plain = Measurements(q=images.q, position=images.position)
    assert without_stated_priors(plain, {"camera": ["wrist"]}) is plain
    counted = without_stated_priors(images, {"camera": ["wrist"], "board": ["board"]})
    calibrator = GeometricCalibrator(camera_cell(8).nominal)
    before, after = (calibrator.build(rows).problem for rows in (images, counted))
    first, second = (
        problem.sensors[1].information_root[:8, :8, 0] for problem in (before, after)
    )  # U^T U is the information on fx to p2
    prior = (first.T @ first - second.T @ second) / torch.as_tensor(images.readings["corner_noise"])[0] ** 2
    assert_close(prior.diagonal(), 1 / torch.tensor(USUAL_DEVIATIONS[:8]).double().square(), rtol=1e-4)
    assert [sensor.name for sensor in after.sensors] == ["corner", "intrinsics", "board scale"]
