"""Statistics of joint and pose errors, against numpy and against figures worked out by hand."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.models import hand_made_model, joints_around
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_vector, transform
from pisigma.validation.held_out.pose_statistics import (
    Comparison,
    ErrorVectors,
    PoseErrors,
    axis_statistics,
    compare_with_nominal,
    error_statistics,
)
from pisigma.validation.held_out.training_summary import AbsoluteJointErrorFigures


@pytest.mark.parametrize(("revolute", "unit", "factor"), [(True, "deg", math.degrees(1)), (False, "mm", 1e3)])
def test_joint_errors_are_of_the_absolute_error_in_file_units(revolute, unit, factor):
    figures = AbsoluteJointErrorFigures.from_errors(
        torch.tensor([-0.3, 0.1, 0.2], dtype=torch.float64), revolute
    )
    assert figures.unit == unit
    average, deviation, maximum = figures.values
    assert_close(average, 0.2 * factor, rtol=1e-14)
    assert_close(deviation, math.sqrt(0.02 / 3) * factor, rtol=1e-14)  # divided by n, as in the paper
    assert_close(maximum, 0.3 * factor, rtol=1e-14)


def test_error_statistics_agree_with_numpy_and_pass_over_nan(generator):
    errors = torch.rand(101, generator=generator, dtype=torch.float64)
    with_gaps = torch.cat([errors, torch.full((5,), torch.nan, dtype=torch.float64)])
    found = error_statistics(with_gaps)
    values = errors.numpy()
    assert_close(found["rms"], np.sqrt((values**2).mean()), atol=1e-14)
    assert_close(found["mean"], values.mean(), atol=1e-14)
    assert_close(found["p95"], np.quantile(values, 0.95), atol=1e-14)
    assert_close(found["max"], values.max())


def test_no_row_to_compare_is_an_error_and_no_nan():
    with refused(MeasurementError, expected="a row with both a measured and a predicted value"):
        error_statistics(torch.full((3,), torch.nan, dtype=torch.float64))


def measured(T: torch.Tensor, q: torch.Tensor, orientation: bool = True) -> Measurements:
    return Measurements(
        q=q, position=T[:, :3, 3].clone(), rotation=T[:, :3, :3].clone() if orientation else None
    )


def test_pose_errors_are_lengths_and_angles(generator):
    q = joints_around("kiro4", 6)
    T = forward_kinematics(hand_made_model("kiro4").robot, q)
    shift = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    turn = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    moved = transform(rotation_from_vector(turn) @ T[:, :3, :3], T[:, :3, 3] + shift)
    errors = PoseErrors.from_prediction(measured(moved, q), T)
    assert_close(errors.position, shift.norm(dim=-1), atol=1e-12)
    assert_close(errors.rotation, turn.norm(dim=-1), atol=1e-9)
    assert PoseErrors.from_prediction(measured(moved, q, orientation=False), T).rotation is None
    assert {"rms_mm", "rms_deg"} < set(errors.figures.figures_by_name)


def test_pose_errors_need_positions():
    q = joints_around("kiro4", 2)
    T = forward_kinematics(hand_made_model("kiro4").robot, q)
    with refused(MeasurementError, expected="positions", value="none"):
        PoseErrors.from_prediction(Measurements(q=q, rotation=T[:, :3, :3].clone()), T)


def test_a_model_explains_what_it_predicts():
    model = hand_made_model("kiro4")
    q = joints_around("kiro4", 10, seed=3)
    found = compare_with_nominal(model, measured(model.forward(q), q))
    assert found.rows_not_predicted == 0
    assert_close(found.corrected.position, 0.0, atol=1e-12)
    assert float(found.nominal.position.min()) > 1e-4


def test_comparison_is_on_the_same_rows():
    nan = torch.nan
    nominal = PoseErrors(torch.tensor([1.0, 2.0, nan, 4.0], dtype=torch.float64), None)
    corrected = PoseErrors(torch.tensor([0.5, nan, nan, 0.5], dtype=torch.float64), None)
    found = Comparison.from_errors(nominal, corrected)
    assert found.rows_not_predicted == 1  # the third row was not measured
    assert torch.equal(found.nominal.position.isnan(), corrected.position.isnan())
    assert_close(found.nominal.figures.mean_mm, 2500.0)
    assert_close(found.corrected.figures.mean_mm, 500.0)


def test_error_vectors_are_measured_minus_expected_along_the_axes(generator):
    q = joints_around("kiro4", 6)
    T = forward_kinematics(hand_made_model("kiro4").robot, q)
    shift = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    turn = torch.randn(6, 3, generator=generator, dtype=torch.float64)
    moved = transform(rotation_from_vector(turn) @ T[:, :3, :3], T[:, :3, 3] + shift)
    errors = ErrorVectors.from_prediction(measured(moved, q), T)
    assert_close(errors.position, shift, atol=1e-12)
    assert_close(errors.rotation, turn, atol=1e-9)
    for index in range(3):
        figures, values = axis_statistics(errors.position[:, index]), shift[:, index].numpy()
        assert_close(figures["mean"], values.mean(), atol=1e-9)
        assert_close(figures["rms"], np.sqrt((values**2).mean()), rtol=1e-8)
        assert_close(figures["p95"], np.quantile(np.abs(values), 0.95), rtol=1e-8)
        assert_close(figures["max"], np.abs(values).max(), rtol=1e-8)
    some = errors.to_pose_errors.mask_other_rows(torch.tensor([True, False] * 3))
    assert torch.equal(some.position.isnan(), torch.tensor([False, True] * 3))
    assert torch.equal(some.rotation.isnan(), torch.tensor([False, True] * 3))


def test_a_bias_shows_in_the_mean_along_an_axis():
    found = axis_statistics(torch.tensor([-3.0, math.nan, 1.0, -1.0], dtype=torch.float64))
    assert found == pytest.approx({"rms": math.sqrt(11 / 3), "mean": -1.0, "p95": 2.8, "max": 3.0}, rel=1e-15)


def test_the_missing_columns_of_rows_without_positions_are_named():
    q = joints_around("kiro4", 2)
    T = forward_kinematics(hand_made_model("kiro4").robot, q)
    with refused(MeasurementError, expected="positions", value="socket"):
        PoseErrors.from_prediction(Measurements(q=q, socket=("a", "b")), T)
