"""Robots that are calibrated side by side are calibrated as each alone."""

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem import problem, side_by_side
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot

CALIBRATOR = GeometricCalibrator(Robot.load("ur10"))


def positions(seed: int, rows: int = 30, noise: float = 5e-5, wrong: float = 0.0) -> Measurements:
    return simulate("ur10", seed=seed, rows=rows, noise=noise, wrong=wrong).measurements


def poses(seed: int) -> Measurements:
    return simulate("ur10", seed=seed, rows=24, noise=5e-5, turn_noise=1e-4).measurements


def repeated(seed: int) -> Measurements:
    once = positions(seed, rows=15)
    return once.select(torch.arange(30) % 15)


def in_two_frames(seed: int) -> Measurements:
    data = positions(seed, rows=40)
    return replace(data, frame=("left",) * 20 + ("right",) * 20, target=("ball", "prism") * 20)


def partly_measured(seed: int) -> Measurements:
    data = poses(seed)
    assert data.rotation is not None
    rotation = data.rotation.clone()
    rotation[::3] = torch.nan
    return replace(data, rotation=rotation)


def stated(seed: int) -> Measurements:
    data = positions(seed)
    return replace(data, sigma_position=torch.full_like(data.q[:, 0], 5e-5))


CASES = {
    "positions": [positions(0), positions(1), positions(2, wrong=0.1), positions(3, noise=0.0)],
    "numbers of rows": [positions(0), positions(1, rows=31), positions(2)],
    "poses": [poses(0), poses(1)],
    "repeated": [repeated(0), repeated(1)],
    "frames and targets": [in_two_frames(0), in_two_frames(1)],
    "partly measured": [partly_measured(0), partly_measured(1)],
    "stated deviations": [stated(0), stated(1)],
}


def assert_same(one: CalibrationResult, other: CalibrationResult) -> None:
    assert one.free == other.free
    assert one.iterations == other.iterations
    assert one.status is other.status
    assert [outlier.row for outlier in one.outliers] == [outlier.row for outlier in other.outliers]
    assert_close(one.robot.dh, other.robot.dh, atol=1e-11)
    for these, those in ((one.bases, other.bases), (one.tools, other.tools)):
        assert list(these) == list(those)
        for name, values in these.items():
            assert_close(values, those[name], atol=1e-11)
    assert_close(one.rms_path[:2], other.rms_path[:2], rtol=1e-9)
    assert_close(one.rms_path[-1], other.rms_path[-1], rtol=1e-6, atol=1e-13)
    size = float(np.abs(other.covariance).max())
    assert_close(one.covariance, other.covariance, atol=1e-6 * size)


@pytest.mark.parametrize("name", sorted(CASES))
def test_robots_side_by_side_are_fitted_as_each_alone(name: str) -> None:
    for many, data in zip(CALIBRATOR.fit_many(CASES[name]), CASES[name], strict=True):
        assert_same(many, CALIBRATOR.fit(data))


def test_data_of_many_kinds_keep_their_order() -> None:
    data = [positions(0), poses(0), positions(1), in_two_frames(0)]
    for result, measurements in zip(CALIBRATOR.fit_many(data), data, strict=True):
        assert result.solved.measurements is measurements
        assert len(result.residuals["position"]) == measurements.rows


@pytest.mark.parametrize("prior_sizes", ["stated", "widened"])
def test_other_sizes_of_the_prior(prior_sizes: str) -> None:
    calibrator = replace(CALIBRATOR, prior_sizes=prior_sizes)
    data = [positions(4), positions(5)]
    for many, one in zip(calibrator.fit_many(data), data, strict=True):
        assert_same(many, calibrator.fit(one))


@pytest.mark.parametrize(
    ("module", "name", "rows"),
    [(problem, "JACOBIAN_CHUNK", 30), (side_by_side, "MOST_ROWS", 60)],
    ids=["chunks", "batches"],
)
def test_many_robots_in_chunks_and_batches(
    module: ModuleType, name: str, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = [positions(seed) for seed in range(4, 9)]
    each = [CALIBRATOR.fit(one) for one in data]
    monkeypatch.setattr(module, name, rows)
    for many, one in zip(CALIBRATOR.fit_many(data), each, strict=True):
        assert_same(many, one)


def test_nothing_is_fitted_to_nothing() -> None:
    assert CALIBRATOR.fit_many([]) == []


def test_a_refusal_names_the_robot_that_it_is_about() -> None:
    wrong = positions(1)
    assert wrong.position is not None
    wrong = replace(wrong, position=1e3 * wrong.position, source="robot 7")
    with pytest.raises(IdentificationError, match="robot 7"):
        CALIBRATOR.fit_many([positions(0), wrong])
