import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.refusals import refused
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.files.errors import IdentificationError, MeasurementError, PoseError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def test_too_few_rows_state_how_many_more_are_needed() -> None:
    arm = simulate("ur10", rows=8)
    with refused(IdentificationError, value=24) as caught:
        GeometricCalibrator(arm.nominal).fit(arm.measurements)
    assert int(re.findall(r"\d+", caught.value.remedy)[0]) > 0  # poses to measure


def test_values_without_limit_are_refused() -> None:
    arm = simulate("ur10", rows=60)
    position = arm.measurements.position.clone()
    position[7, 0] = 1e300
    with refused(IdentificationError, file=None, option=""):
        GeometricCalibrator(arm.nominal).fit(replace(arm.measurements, position=position))


def test_an_empty_name_is_refused() -> None:
    with refused(IdentificationError, option="free", value=("a_2", "")):
        GeometricCalibrator(Robot.load("ur10"), free=("a_2", ""))


def test_few_rows_do_not_reduce_the_number_of_parameters() -> None:
    """The rank of three positions is at most nine, but many more parameters have to be estimated."""
    arm = simulate("ur10", rows=3)
    with refused(IdentificationError, expected="more than 39 values", value=9) as caught:
        GeometricCalibrator(arm.nominal).fit(arm.measurements)
    assert re.findall(r"\d+", caught.value.remedy) == ["36"]  # poses to measure


def test_a_list_longer_than_the_data_is_refused() -> None:
    arm = simulate("ur10", rows=10)
    names = [f"{column}_{row}" for row in range(1, 7) for column in ("theta", "d", "a", "alpha", "beta")]
    with refused(IdentificationError, value=30):
        GeometricCalibrator(arm.nominal, free=names).fit(arm.measurements)


def test_few_rows_are_warned_of() -> None:
    arm = simulate("ur10", rows=20, noise=5e-5)
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    (warning,) = (one for one in result.warning_details if one.kind == "few_values")
    assert re.findall(r"\d+", warning.sentence)[:2] == ["60", "27"]  # values and free parameters
    assert warning.sentence in result.warnings


def test_rows_of_one_pose_are_refused() -> None:
    arm = simulate("ur10", rows=1)
    assert arm.measurements.position is not None
    many = Measurements(q=arm.measurements.q.repeat(50, 1), position=arm.measurements.position.repeat(50, 1))
    with refused(IdentificationError, expected="different joint values", value=50):
        GeometricCalibrator(arm.nominal).fit(many)


def test_repeats_are_no_new_poses() -> None:
    arm = simulate("ur10", rows=8, noise=1e-5)
    assert arm.measurements.position is not None
    many = Measurements(q=arm.measurements.q.repeat(50, 1), position=arm.measurements.position.repeat(50, 1))
    with refused(IdentificationError, value=24):
        GeometricCalibrator(arm.nominal).fit(many)


def test_nan_joint_values_are_refused_before() -> None:
    q = simulate("ur10", rows=30).measurements.q.clone()
    q[3, 2] = torch.nan
    with pytest.raises(MeasurementError, match="row 3"):
        Measurements(q=q, position=torch.zeros(30, 3, dtype=torch.float64))


def test_rows_without_any_value_are_refused() -> None:
    arm = simulate("ur10", rows=30)
    nothing = replace(arm.measurements, position=torch.full((30, 3), torch.nan, dtype=torch.float64))
    with refused(IdentificationError, expected="measured values"):
        GeometricCalibrator(arm.nominal).fit(nothing)
    with refused(IdentificationError, expected="measured values"):
        GeometricCalibrator(arm.nominal).fit(Measurements(q=arm.measurements.q))


def test_a_robot_with_fewer_joints_than_columns_is_refused() -> None:
    with pytest.raises(PoseError, match=r"6 joints.*7 columns"):
        GeometricCalibrator(Robot.load("ur10")).fit(simulate("panda", rows=30).measurements)


def test_a_joint_that_hardly_moves_is_named() -> None:
    arm = simulate("ur10", rows=80)
    q = arm.measurements.q.clone()
    q[:, 4] = 0.7 + 0.01 * q[:, 4]
    data = Measurements(q=q, position=forward_kinematics(arm.true, q)[:, :3, 3].contiguous())
    result = GeometricCalibrator(arm.nominal).fit(data)
    assert ("still_joint", "theta_5") in [(one.kind, one.subject) for one in result.warning_details]


def test_a_target_on_the_axis_is_named_unless_orientations_are_measured() -> None:
    on_axis = np.array([1e-4, 0.0, 0.1, 0.0, 0.0, 0.0])
    positions = simulate("ur10", rows=60, noise=2e-5, tool=on_axis)
    result = GeometricCalibrator(positions.nominal).fit(positions.measurements)
    assert ("target_on_axis", "theta_6") in [(one.kind, one.subject) for one in result.warning_details]
    poses = simulate("ur10", rows=60, noise=2e-5, turn_noise=1e-4, tool=on_axis)
    assert GeometricCalibrator(poses.nominal).fit(poses.measurements).warnings == ()


def test_a_standard_deviation_in_some_rows_only_is_refused() -> None:
    arm = simulate("ur10", rows=30)
    sigma = torch.full((30,), 1e-4, dtype=torch.float64)
    sigma[11] = torch.nan
    with refused(IdentificationError, file="memory", column="sigma_mm") as caught:
        GeometricCalibrator(arm.nominal).fit(replace(arm.measurements, sigma_position=sigma))
    assert "row 11" in str(caught.value)


@pytest.mark.parametrize(
    ("option", "value"), [("free", "everything"), ("elimination", "qr"), ("base", "unknown")]
)
def test_options_that_do_not_exist_are_refused(option: str, value: str) -> None:
    with refused(IdentificationError, option=option, value=value):
        GeometricCalibrator(Robot.load("ur10"), **{option: value})  # type: ignore[arg-type]


def test_a_misspelt_parameter_is_refused_with_the_nearest_name() -> None:
    arm = simulate("ur10", rows=30)
    with refused(IdentificationError, value="thta_2") as caught:
        GeometricCalibrator(arm.nominal, free=["thta_2"]).fit(arm.measurements)
    assert "theta_2" in caught.value.remedy


@pytest.mark.parametrize("value", [0.0, -1e-3, float("nan"), float("inf")])
def test_an_invalid_prior_is_refused(value: float) -> None:
    with refused(IdentificationError, option="prior 'alpha'", expected="a standard deviation >= 1e-12 rad"):
        Prior(alpha=value)
