"""Rows that count more or less, repeats of a pose as one row, and targets of a configuration that err alike."""

from dataclasses import replace

import torch
from testing.closeness import assert_close
from testing.linearised import random_joints, tracker_data
from torch import Tensor

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.design import Design, LinearisedRows
from pisigma.calibration.hybrid.regression import NormalEquations
from pisigma.calibration.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def values_of(rows: int) -> SensorValues:
    def normal(*shape: int) -> Tensor:
        return torch.randn(
            rows, *shape, generator=torch.Generator().manual_seed(len(shape)), dtype=torch.float64
        )

    return SensorValues(
        "position", torch.arange(rows), normal(3, 2), normal(3, 6), normal(3), normal().abs(), True, False
    )


def sums_of(design: Design, values: SensorValues) -> NormalEquations:
    group = torch.zeros(design.problem.q.shape[0], dtype=torch.int64)
    return NormalEquations.from_rows(design, LinearisedRows(design.problem, (values,), group))


def test_excluded_rows_are_left_out_and_the_others_weighted() -> None:
    values = values_of(5)
    found = values.apply_weights(torch.tensor([1.0, 0.0, 0.25, 0.0, 4.0], dtype=torch.float64))
    assert found.row.tolist() == [0, 2, 4]
    assert found.components == 3
    assert_close(found.weight_root, values.weight_root[[0, 2, 4]] * torch.tensor([1.0, 0.5, 2.0]), atol=1e-15)
    assert_close(found.geometry_derivatives, values.geometry_derivatives[[0, 2, 4]])


def test_repeats_as_one_row_come_to_the_same_normal_equations() -> None:
    """Of repeats whose derivatives are equal: only what they differ by among themselves is lost."""
    robot = Robot.load("panda")
    data = tracker_data(robot, random_joints(robot, 40, 0), turn_noise=0.0, several=True)
    problem = GeometricCalibrator(robot).build(data).problem.with_active(range(20))
    pose = torch.tensor([2, 0, 2, 1, 2, 0, 3])
    own = values_of(4)
    values = replace(
        values_of(7),
        row=pose,
        geometry_derivatives=values_of(4)
        .geometry_derivatives[pose, :, :1]
        .expand(-1, -1, len(problem.active)),
        joint_derivatives=torch.cat([own.joint_derivatives, own.joint_derivatives[..., :1]], -1)[pose],
    )
    design = Design(problem, (FourierSeries(robot, 1),))
    collapsed = values.merge_repeats(torch.arange(problem.q.shape[0]))
    assert collapsed.row.tolist() == [0, 1, 2, 3]
    many, few = (sums_of(design, one) for one in (values, collapsed))
    assert_close(few.normal, many.normal, atol=1e-11)
    assert_close(few.descent, many.descent, atol=1e-11)
    assert (few.sensors[0].values, many.sensors[0].values) == (12.0, 21.0)
    mean = torch.stack([values.residual[pose == k].T @ values.weight_root[pose == k] ** 2 for k in range(4)])
    total = torch.stack([(values.weight_root[pose == k] ** 2).sum() for k in range(4)])
    assert_close(few.squared_values[0], float((mean.square().sum(1) / total).sum()), rtol=1e-12)
    assert few.squared_values[0] < many.squared_values[0]


def test_repeats_whose_joint_values_encoders_read_are_one_row() -> None:
    """Their joint values differ by the repeatability of the controller."""
    robot, random = Robot.load("ur5"), torch.Generator().manual_seed(0)
    q = random_joints(robot, 20, 0).repeat(5, 1)
    q = q + 1e-4 * torch.randn(q.shape, generator=random, dtype=torch.float64)
    problem = (
        GeometricCalibrator(robot).build(Measurements(q, forward_kinematics(robot, q)[:, :3, 3])).problem
    )
    assert problem.pose is not None
    (values,) = sensor_values(problem.with_active(range(30)), problem.prior_mean)
    assert len(values.merge_repeats(problem.pose).row) == 20


def test_other_sights_of_a_pose_are_no_repeats() -> None:
    """Touches along three axes, each made twice: six rows of one pose are three."""
    robot = Robot.load("welding")
    q = random_joints(robot, 20, 0)
    p = forward_kinematics(robot, q)[:, :3, 3].contiguous()
    data = Measurements(
        q=q.repeat_interleave(6, 0),
        touch=p.repeat_interleave(2, 1).flatten(),
        touch_axis=("x", "x", "y", "y", "z", "z") * 20,
        frame=("jig",) * 120,
    )
    problem = GeometricCalibrator(robot, base_guesses={"jig": (0.0,) * 6}).build(data).problem
    assert problem.pose is not None
    (values,) = sensor_values(problem.with_active(range(30)), problem.prior_mean)
    collapsed = values.merge_repeats(problem.pose)
    assert len(values.row) == 120
    assert len(collapsed.row) == 60
    assert_close(collapsed.weight_root, torch.full((60,), 2.0).double().sqrt(), atol=1e-12)
    design = Design(problem.with_active(range(30)), (FourierSeries(robot, 1),))
    many, few = (sums_of(design, one) for one in (values, collapsed))
    assert_close(few.normal, many.normal, atol=1e-10)
    assert_close(few.descent, many.descent, atol=1e-10)


def test_rows_without_repeats_are_accepted() -> None:
    values = values_of(6)
    assert values.merge_repeats(torch.arange(6)) is values
    none = values.select(torch.zeros(6, dtype=torch.bool))
    assert none.merge_repeats(torch.arange(6)) is none


def alike(copies: int) -> SensorValues:
    """Eight configurations that were seen of so many targets, whose residuals are the same."""
    one = values_of(8)
    many = one.select(torch.arange(8).repeat_interleave(copies))
    return replace(many, row=torch.arange(8 * copies))


def test_three_identical_targets_of_a_configuration_count_as_one() -> None:
    """The design effect: three times the values say as much as one of them."""
    copies = alike(3)
    found = copies.downweight_correlated(torch.arange(8).repeat_interleave(3))
    assert_close(found.repeat_variance_factor, 3.0, rtol=1e-12)
    assert_close(found.weight_root, copies.weight_root / 3**0.5, rtol=1e-12)
    one = values_of(8)
    weight = found.weight_root.square().view(8, 3).sum(1)
    assert_close(weight, one.weight_root.square(), rtol=1e-12)
    assert_close(found.residual, copies.residual)


def test_identical_targets_come_to_the_regression_of_one() -> None:
    robot = Robot.load("panda")
    problem = GeometricCalibrator(robot).build(tracker_data(robot, random_joints(robot, 24, 0))).problem
    problem = problem.with_active(range(2))
    design = Design(problem, ())
    three = alike(3).downweight_correlated(torch.arange(8).repeat_interleave(3))
    rows = [LinearisedRows(problem, (values,), torch.arange(24)) for values in (three, values_of(8))]
    many, single = (NormalEquations.from_rows(design, one) for one in rows)
    assert_close(many.normal, single.normal, rtol=1e-12)
    assert_close(many.descent, single.descent, rtol=1e-12, atol=1e-12)
    assert_close(many.squared_values[0], single.squared_values[0], rtol=1e-12)
    assert_close(many.sensors[0].values, 24.0, rtol=1e-12)
    assert single.sensors[0].values == 24.0
    prior = design.prior((1.0,) * 4)
    found, expected = (form.solve(prior, (0.7,)) for form in (many, single))
    assert_close(found.log_evidence, expected.log_evidence, rtol=1e-10)
    assert_close(many.updated_noise(found)[0], single.updated_noise(expected)[0], rtol=1e-10)


def test_targets_with_independent_errors_have_full_weight() -> None:
    values = values_of(3_000)
    values = replace(values, residual=values.residual / values.weight_root[:, None])
    independent = values.downweight_correlated(torch.arange(1_000).repeat_interleave(3))
    assert 1.0 <= independent.repeat_variance_factor < 1.1
    opposite = alike(2)
    sign = torch.tensor([1.0, -1.0]).double().repeat(8)[:, None]
    opposite = replace(opposite, residual=opposite.residual * sign)
    assert opposite.downweight_correlated(torch.arange(8).repeat_interleave(2)).repeat_variance_factor == 1.0


def test_exact_values_pairs_and_single_targets_have_full_weight() -> None:
    copies, configuration = alike(3), torch.arange(8).repeat_interleave(3)
    certain = replace(copies, are_values_given=True)
    assert certain.downweight_correlated(configuration) is certain
    pair = replace(copies, other_row=copies.row, other_joint_derivatives=copies.joint_derivatives)
    assert pair.downweight_correlated(configuration) is pair
    none = copies.select(slice(0, 0))
    assert none.downweight_correlated(configuration) is none
    assert_close(copies.downweight_correlated(torch.arange(24)).repeat_variance_factor, 1.0, rtol=1e-12)
