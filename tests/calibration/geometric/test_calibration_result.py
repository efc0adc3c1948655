from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused
from testing.simulated_arm import BASE, TOOL, draw_joints, simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.identifiability.observability import observability_of
from pisigma.calibration.geometric.problem.setup import zyx_axes
from pisigma.calibration.geometric.result import CalibrationResult
from pisigma.files.errors import IdentificationError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector, rotation_from_zyx, rotation_vector, wrap_to_pi


@pytest.fixture(scope="module")
def result() -> CalibrationResult:
    arm = simulate("ur5", rows=80, noise=5e-5, turn_noise=1e-4)
    return GeometricCalibrator(arm.nominal).fit(arm.measurements)


def test_the_table_fits_the_robot(result: CalibrationResult) -> None:
    table = {parameter.name: parameter for parameter in result.parameters}
    assert_close(np.array([table[f"d_{row}"].estimated for row in range(1, 7)]), result.robot.dh[:, 1])
    assert_close(np.array([table[f"base_{x}"].estimated for x in ("x", "y", "z")]), result.robot.base[:3])
    for parameter in result.parameters:
        difference = parameter.estimated - parameter.nominal
        turn = (
            wrap_to_pi(torch.tensor(difference, dtype=torch.float64))
            if parameter.unit == "rad"
            else difference
        )
        assert_close(parameter.change, float(turn), atol=1e-15)
        assert parameter.free == (parameter.name in result.free_parameters)
    assert table["d_2"].remark == "d_2 + d_3 + d_4 is identified; the individual values are not"
    assert table["a_2"].remark == "identified"
    assert result.parameter("a_2") is table["a_2"]


def test_errors_are_the_roots_of_the_covariance(result: CalibrationResult) -> None:
    assert_close(result.covariance, result.covariance.T, atol=1e-20)
    assert np.linalg.eigvalsh(result.covariance)[0] > -1e-18
    for parameter, variance in zip(result.parameters, result.covariance.diagonal(), strict=True):
        assert_close(parameter.standard_error if parameter.free else 0.0, variance**0.5, rtol=1e-9)


def test_noise_is_recovered_and_counted(result: CalibrationResult) -> None:
    assert [noise.sensor for noise in result.noise] == ["position", "rotation"]
    assert_close(result.noise[0].sigma, 5e-5, rtol=0.15)
    assert_close(result.noise[1].sigma, 1e-4, rtol=0.15)
    assert_close(
        sum(noise.effective_parameters for noise in result.noise), len(result.free_parameters), atol=1.0
    )
    assert_close(result.noise[0].rms, result.rms_path[-1], rtol=1e-6)


def test_observability_and_rank(result: CalibrationResult) -> None:
    assert result.rank == 30
    assert_close(result.condition_number * result.observability.O2, 1.0, atol=1e-9)
    assert result.observability.O5 < result.observability.O3 < result.observability.O1 * 80**0.5
    assert result.pairwise_redundancy.no_effect == ()


def test_observability_indices_of_a_known_matrix() -> None:
    found = observability_of(torch.diag(torch.tensor([16.0, 4.0, 1.0], dtype=torch.float64)), poses=4)
    assert_close(
        np.array([found.O1, found.O2, found.O3, found.O4, found.O5]),
        np.array([1.0, 0.25, 1.0, 0.25, 1 / 1.75]),
        rtol=1e-12,
    )
    unseen = observability_of(torch.diag(torch.tensor([1.0, 0.0], dtype=torch.float64)), poses=4)
    assert unseen.O1 == unseen.O2 == 0.0
    assert unseen.condition_number == float("inf")


def test_the_result_is_frozen(result: CalibrationResult) -> None:
    with pytest.raises(FrozenInstanceError):
        result.cost = 0.0  # type: ignore[misc]


def test_turning_axes_are_the_derivative_of_the_rotation() -> None:
    rpy = torch.tensor([0.7, -0.4, 1.9], dtype=torch.float64)
    for index in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[index] = 1e-6
        turn = rotation_vector(rotation_from_zyx(rpy + step) @ rotation_from_zyx(rpy - step).mT) / 2e-6
        assert_close(zyx_axes(rpy)[:, index], turn, atol=1e-9)


def test_unknown_frames_and_targets_are_refused(result: CalibrationResult) -> None:
    data = simulate("ur5", rows=5).measurements
    with refused(IdentificationError, column="target", value="X") as caught:
        result.errors_of(replace(data, target=("X",) * 5))
    assert "row 0" in str(caught.value)
    with refused(IdentificationError, column="frame", value="left") as caught:
        result.errors_of(replace(data, frame=("", "", "left", "", "")))
    assert "row 2" in str(caught.value)


@pytest.mark.parametrize("poses", [True, False])
def test_intervals_cover_the_truth(poses: bool) -> None:
    """95 % intervals, with new errors, poses and noise each time; errors only where values are identified.

    A repetition's parameters share their noise, so 30 of them scatter by 1.3 %; three times that is allowed.
    """
    nominal = Robot.load("ur10")
    calibrator = GeometricCalibrator(nominal)
    first = simulate("ur10", rows=60, length=0, angle=0, turn_noise=0.0 if poses else None)
    kept = calibrator.fit(first.measurements).redundancy.kept
    columns = ("theta", "d", "a", "alpha", "beta")
    free = np.array([[f"{column}_{row}" in kept for column in columns] for row in range(1, 7)])
    truths, data = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        errors = 1e-3 * rng.normal(size=nominal.dh.shape) * free
        true = nominal.with_geometry(dh=nominal.dh + errors, base=BASE, tool=TOOL)
        q = draw_joints(nominal, 80, rng)
        T = forward_kinematics(true, q)
        position = T[:, :3, 3] + 5e-5 * torch.from_numpy(rng.normal(size=(80, 3)))
        turn = rotation_from_vector(1e-4 * torch.from_numpy(rng.normal(size=(80, 3))))
        rotation = turn @ T[:, :3, :3] if poses else None
        data.append(Measurements(q=q, position=position, rotation=rotation))
        truths.append(np.concatenate([true.dh.ravel(), BASE, TOOL]))
    covered = [
        abs(parameter.estimated - value) < 1.96 * parameter.standard_error
        for result, truth in zip(map(calibrator.fit, data), truths, strict=True)
        for parameter, value in zip(result.parameters, truth, strict=True)
        if parameter.name in kept
    ]
    assert len(covered) == 30 * (30 if poses else 27)
    assert 0.91 < np.mean(covered) < 0.99


def test_parallel_axes_leave_the_tool_at_its_nominal_height_and_the_base_in_sums():
    """A base that is tilted in the measuring frame is undetermined along all axes, not only along its own z axis."""
    tilted = np.array([0.5, 0.2, -0.1, 0.3, 0.1, -0.1])
    nominal = Robot.load("kiro3").with_geometry(tool=np.array([0.0, 0.01, 0.05, 0.0, 0.0, 0.0]))
    true = nominal.with_geometry(base=tilted, tool=np.array([0.03, 0.02, 0.11, 0.0, 0.0, 0.0]))
    q = torch.from_numpy(np.random.default_rng(0).uniform(*np.clip(true.limits, -3, 3).T, (60, 4)))
    result = GeometricCalibrator(nominal).fit(Measurements(q, forward_kinematics(true, q)[:, :3, 3]))
    assert_close(result.robot.tool[2], 0.05, atol=1e-9)
    by_name = {one.name: one for one in result.parameters}
    for name, value in zip(("base_x", "base_y", "base_z"), tilted, strict=False):
        assert abs(by_name[name].estimated - value) > 1e-3
        assert by_name[name].short_remark == "in a sum"
