"""Rows of some groups, folds of them, residuals counted from nominal, and weights by distance."""

import math
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, random_joints, tracker_data
from testing.linearised import linearised as linearised_at_solution

from pisigma.calibration.hybrid.design import Design, LinearisedRows, robust_weights
from pisigma.calibration.hybrid.refinement import correction_from_weights, linearise_rows
from pisigma.calibration.hybrid.sensor_values import sensor_values
from pisigma.estimation.loss import HampelLoss, SquaredLoss
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.robot import Robot


@pytest.fixture(scope="module")
def arm() -> LinearisedArm:
    """40 different joint values, the first 10 of them twice."""
    robot = Robot.load("rb5")
    q = random_joints(robot, 40, 0)
    data = tracker_data(robot, torch.cat([q, q[:10]]), noise=3e-5, turn_noise=1e-4)
    return linearised_at_solution(robot, data)


def test_rows_of_a_group_are_never_parted(arm: LinearisedArm) -> None:
    rows = arm.rows
    assert rows.groups == 40
    some = rows.select_groups(torch.arange(0, 40, 3))
    for sensor in some.values:
        expected = torch.isin(rows.group, torch.arange(0, 40, 3)).nonzero()[:, 0]
        assert sensor.row.tolist() == [row for row in rows.values[0].row.tolist() if row in expected]


def test_what_is_certain_is_not_held_out(arm: LinearisedArm) -> None:
    certain = replace(
        arm.rows, values=(arm.rows.values[0], replace(arm.rows.values[1], are_values_given=True))
    )
    groups = torch.tensor([3, 4, 20])
    position, rotation = certain.held_out_rows(groups).values
    assert_close(position.residual, certain.select_groups(groups).values[0].residual)
    assert len(rotation.row) == 0
    assert rotation.residual.shape == (0, 3)


def test_folds_are_the_same_every_time_and_hold_every_group_once(arm: LinearisedArm) -> None:
    folds = arm.rows.folds(4, 400)
    assert [len(fold) for fold in folds] == [10] * 4
    assert sorted(torch.cat(folds).tolist()) == list(range(40))
    assert all(torch.equal(one, other) for one, other in zip(folds, arm.rows.folds(4, 400), strict=True))
    assert [fold.tolist() for fold in folds] != [list(range(k, 40, 4)) for k in range(4)]


def test_numbers_of_groups_and_folds_are_limited(arm: LinearisedArm) -> None:
    some = arm.rows.folds(4, 12)
    assert [len(fold) for fold in some] == [3] * 4
    assert len(set(torch.cat(some).tolist())) == 12
    assert [len(fold) for fold in arm.rows.folds(100, 400)] == [1] * 40


def test_repeats_of_a_pose_count_as_one_row_with_their_weight(arm: LinearisedArm) -> None:
    """40 poses, ten of them measured twice."""
    for sensor in arm.rows.values:
        assert len(sensor.row) == 40
        assert sorted(sensor.weight_root.square().round().tolist()) == [1.0] * 30 + [2.0] * 10
    assert [one.values for one in arm.rows.sensors] == [120.0, 120.0]


def test_residuals_are_counted_from_nominal_and_no_correction(arm: LinearisedArm) -> None:
    """Wherever the values were linearised, the same unknowns leave what they leave there."""
    robot, problem = arm.rows.problem.space.robot, arm.rows.problem
    design = Design(problem, (FourierSeries(robot, 2),))
    x = 1e-4 * torch.randn(design.unknowns, generator=torch.Generator().manual_seed(2)).double()
    point = problem.prior_mean.index_add(0, problem.active, x[: design.active_count])
    values = sensor_values(problem, point, correction_from_weights(design, x))
    weights = [torch.ones_like(sensor.weight_root) for sensor in values]
    bare = replace(problem, pose=None)
    found = LinearisedRows.from_linearisation(
        replace(design, problem=bare), x, values, weights, arm.rows.group
    )
    for there, sensor in zip(values, found.values, strict=True):
        left = sensor.residual - design.columns(sensor, slice(None)) @ x
        assert_close(left, there.residual, atol=1e-15)
    with_network = linearise_rows(design, x, 10.0, arm.rows.group)
    assert with_network.squared_difference(with_network, x, design, (1e-5, 1e-4)) == 0.0


def test_rows_agree_as_far_as_their_weighted_residuals_are_equal(arm: LinearisedArm) -> None:
    design = Design(arm.rows.problem, ())
    x = 1e-4 * torch.randn(design.unknowns, generator=torch.Generator().manual_seed(2)).double()
    first, second = arm.rows.values
    off = replace(arm.rows, values=(replace(first, residual=first.residual + 2e-5), second))
    expected = float((first.weight_root.square() * 3 * 4e-10).sum()) / 1e-10
    assert_close(off.squared_difference(arm.rows, x, design, (1e-5, 1e-4)), expected, rtol=1e-9)
    heavier = replace(arm.rows, values=(replace(first, weight_root=2 * first.weight_root), second))
    left = (first.residual - first.geometry_derivatives @ x) * first.weight_root[:, None]
    expected = float(left.square().sum()) / 1e-10
    assert_close(heavier.squared_difference(arm.rows, x, design, (1e-5, 1e-4)), expected, rtol=1e-9)
    fewer = arm.rows.select_groups(torch.arange(39))
    assert fewer.squared_difference(arm.rows, x, design, (1e-5, 1e-4)) == math.inf


def test_far_off_rows_count_less_and_squared_loss_counts_all_alike(arm: LinearisedArm) -> None:
    problem, (first, second) = arm.rows.problem, arm.rows.values
    residual = 3e-5 * torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    residual[7] += 5e-3
    values = (
        replace(first, residual=residual, weight_root=torch.ones(40).double()),
        replace(second, are_values_given=True),
    )
    robust, certain = robust_weights(replace(problem, loss=HampelLoss()), values, 20.0)
    assert float(robust[7]) == 0.0
    assert float(robust[torch.arange(40) != 7].mean()) > 0.97
    assert_close(certain, torch.ones(40))
    squared, _ = robust_weights(replace(problem, loss=SquaredLoss()), values, 20.0)
    assert_close(squared, torch.ones(40))


def test_the_scale_of_a_sensor_grows_with_the_unknowns_that_its_values_determine(arm: LinearisedArm) -> None:
    """So that rows count more where much was fitted to them."""
    problem, values = replace(arm.rows.problem, loss=HampelLoss()), arm.rows.values
    residual = torch.randn(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values = tuple(replace(sensor, residual=3e-5 * residual) for sensor in values)
    few, many = (robust_weights(problem, values, used)[0] for used in (0.0, 120.0))
    assert float(few.min()) < 1.0
    assert float((many - few).min()) >= 0.0
    assert float(many.sum()) > float(few.sum())


def test_rows_of_which_nothing_was_measured_are_weighted_too(arm: LinearisedArm) -> None:
    first, second = arm.rows.values
    _, none = robust_weights(arm.rows.problem, (first, second.select(slice(0, 0))), 10.0)
    assert none.shape == (0,)
