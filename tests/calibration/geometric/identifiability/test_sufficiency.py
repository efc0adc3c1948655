from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.simulated_arm import simulate

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.geometric.problem.parameters import Prior
from pisigma.files.errors import IdentificationError, MeasurementError, PoseError
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def test_too_few_rows_say_how_many_more() -> None:
    arm = simulate("ur10", rows=8)
    with pytest.raises(
        IdentificationError, match=r"8 different poses give 24 values for \d+ free .* about \d+ more"
    ):
        GeometricCalibrator(arm.nominal).fit(arm.measurements)


def test_values_without_limit_are_refused() -> None:
    arm = simulate("ur10", rows=60)
    position = arm.measurements.position.clone()
    position[7, 0] = 1e300
    with pytest.raises(
        IdentificationError, match="the normal equations are not finite; look for huge values"
    ):
        GeometricCalibrator(arm.nominal).fit(replace(arm.measurements, position=position))


def test_an_empty_name_is_refused() -> None:
    with pytest.raises(IdentificationError, match=r"free=\('a_2', ''\): a name is empty"):
        GeometricCalibrator(Robot.load("ur10"), free=("a_2", ""))


def test_few_rows_do_not_make_few_parameters() -> None:
    """The rank of three positions is nine at most; many more have to be told."""
    arm = simulate("ur10", rows=3)
    with pytest.raises(IdentificationError, match=r"9 values for 39 free parameters.* about 36 more poses"):
        GeometricCalibrator(arm.nominal).fit(arm.measurements)


def test_a_list_longer_than_the_data_is_refused() -> None:
    arm = simulate("ur10", rows=10)
    names = [f"{column}_{row}" for row in range(1, 7) for column in ("theta", "d", "a", "alpha", "beta")]
    with pytest.raises(
        IdentificationError, match=r"10 different poses give 30 values for 3[0-9] free parameters"
    ):
        GeometricCalibrator(arm.nominal, free=names).fit(arm.measurements)


def test_few_rows_are_warned_of() -> None:
    arm = simulate("ur10", rows=20, noise=5e-5)
    result = GeometricCalibrator(arm.nominal).fit(arm.measurements)
    assert any("60 values are few for 27 free parameters" in warning for warning in result.warnings)


def test_rows_of_one_pose_are_refused() -> None:
    arm = simulate("ur10", rows=1)
    assert arm.measurements.position is not None
    many = Measurements(q=arm.measurements.q.repeat(50, 1), position=arm.measurements.position.repeat(50, 1))
    with pytest.raises(IdentificationError, match=r"all 50 rows are one pose.*other joint values"):
        GeometricCalibrator(arm.nominal).fit(many)


def test_repeats_are_no_new_poses() -> None:
    arm = simulate("ur10", rows=8, noise=1e-5)
    assert arm.measurements.position is not None
    many = Measurements(q=arm.measurements.q.repeat(50, 1), position=arm.measurements.position.repeat(50, 1))
    with pytest.raises(IdentificationError, match="8 different poses give 24 values"):
        GeometricCalibrator(arm.nominal).fit(many)


def test_nan_joint_values_are_refused_before() -> None:
    q = simulate("ur10", rows=30).measurements.q.clone()
    q[3, 2] = torch.nan
    with pytest.raises(MeasurementError, match="row 3"):
        Measurements(q=q, position=torch.zeros(30, 3, dtype=torch.float64))


def test_rows_without_any_value_are_refused() -> None:
    arm = simulate("ur10", rows=30)
    nothing = replace(arm.measurements, position=torch.full((30, 3), torch.nan, dtype=torch.float64))
    with pytest.raises(IdentificationError, match="none of its 30 rows has a measured value"):
        GeometricCalibrator(arm.nominal).fit(nothing)
    with pytest.raises(IdentificationError, match="x_mm"):
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
    assert any(warning.startswith("joint theta_5 moves by") for warning in result.warnings)


def test_a_target_on_the_axis_is_named_unless_orientations_are_measured() -> None:
    on_axis = np.array([1e-4, 0.0, 0.1, 0.0, 0.0, 0.0])
    positions = simulate("ur10", rows=60, noise=2e-5, tool=on_axis)
    result = GeometricCalibrator(positions.nominal).fit(positions.measurements)
    assert any("from the axis of joint theta_6" in warning for warning in result.warnings)
    poses = simulate("ur10", rows=60, noise=2e-5, turn_noise=1e-4, tool=on_axis)
    assert GeometricCalibrator(poses.nominal).fit(poses.measurements).warnings == ()


def test_a_standard_deviation_in_some_rows_only_is_refused() -> None:
    arm = simulate("ur10", rows=30)
    sigma = torch.full((30,), 1e-4, dtype=torch.float64)
    sigma[11] = torch.nan
    with pytest.raises(
        IdentificationError, match="sigma_mm is stated in some rows but not in memory, row 11"
    ):
        GeometricCalibrator(arm.nominal).fit(replace(arm.measurements, sigma_position=sigma))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"free": "everything"}, "free='everything' is not valid; valid: identifiable, joint_offsets"),
        ({"elimination": "qr"}, "elimination='qr' is no choice; valid: exact, pairwise, none"),
        ({"base": "unknown"}, "base='unknown' is no choice; valid: free, fixed"),
    ],
)
def test_options_that_do_not_exist_are_refused(options: dict[str, str], message: str) -> None:
    with pytest.raises(IdentificationError, match=message):
        GeometricCalibrator(Robot.load("ur10"), **options)  # type: ignore[arg-type]


def test_a_misspelt_parameter_is_refused_with_the_nearest_name() -> None:
    arm = simulate("ur10", rows=30)
    with pytest.raises(IdentificationError, match="no parameter 'thta_2'; did you mean 'theta_2'"):
        GeometricCalibrator(arm.nominal, free=["thta_2"]).fit(arm.measurements)


@pytest.mark.parametrize("value", [0.0, -1e-3, float("nan"), float("inf")])
def test_a_prior_that_is_none_is_refused(value: float) -> None:
    with pytest.raises(
        IdentificationError, match="prior 'alpha': a standard deviation in rad of 1e-12 or more"
    ):
        Prior(alpha=value)
