"""Unknowns of a design, their prior and their columns, and what they change."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, linearised, random_joints, tracker_data
from testing.regression_cases import all_kinds

from pisigma.calibration.hybrid.design import Design
from pisigma.estimation.prior import FIRST_SIZE
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot


@pytest.fixture(scope="module")
def arm() -> LinearisedArm:
    robot = Robot.load("kiro3")
    q = random_joints(robot, 60, 0)
    delta = 1e-4 * torch.sin(3 * q)
    return linearised(robot, tracker_data(robot, q, delta, 1e-5, turn_noise=1e-5, several=True))


def features(robot: Robot, harmonics: int) -> tuple[AbstractFeature, ...]:
    return ScaledJoints(robot), GravityTorques(robot), FourierSeries(robot, harmonics)


def test_what_unknowns_move_is_their_columns_times_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever fits into a chunk; of sensors of all kinds, distances between two rows among them."""
    case = all_kinds()
    x = 1e-4 * torch.randn(case.design.unknowns, generator=torch.Generator().manual_seed(1)).double()
    for chunk in (2_048, 7):
        monkeypatch.setattr("pisigma.calibration.hybrid.design.CHUNK", chunk)
        for values in case.rows.values:
            expected = case.design.columns(values, slice(None)) @ x
            assert_close(case.design.predicted_change(values, x), expected, atol=1e-14)
    geometry = Design(case.rows.problem, ())
    values = case.rows.values[0]
    moved = geometry.predicted_change(values, x[: geometry.unknowns])
    assert_close(moved, values.geometry_derivatives @ x[: geometry.unknowns], atol=1e-15)


def test_the_correction_is_the_weighted_sum_of_the_used_columns(arm: LinearisedArm) -> None:
    robot = arm.rows.problem.space.robot
    design = Design(arm.rows.problem, features(robot, 3))
    x = torch.randn(design.unknowns, generator=torch.Generator().manual_seed(1)).double()
    q = random_joints(robot, 6, 4)
    made = JointCorrection(robot, design.features).requires_grad_(False)
    for number, chosen in enumerate(design.features):
        made.linear[number][chosen.used] = x[design.weights_of(number)]
    assert_close(design.correction(x, JointState(q)), made(q), atol=1e-13)


@pytest.mark.parametrize("chosen", [(0,), (1, 2), (2,), (2, 0), ()])
def test_columns_of_a_smaller_design_are_a_part_of_those_of_a_larger(
    arm: LinearisedArm, chosen: tuple[int, ...]
) -> None:
    """Of fewer features, in another order, and of a series with fewer harmonics."""
    robot = arm.rows.problem.space.robot
    large = Design(arm.rows.problem, features(robot, 7))
    small = Design(arm.rows.problem, tuple(features(robot, 3)[k] for k in chosen))
    places = large.indices(small.features)
    assert len(places) == len(set(places.tolist())) == small.unknowns
    values = arm.rows.values[1]
    assert_close(large.columns(values, slice(None))[..., places], small.columns(values, slice(None)))


def test_a_prior_starts_from_the_sizes_that_another_design_came_to(arm: LinearisedArm) -> None:
    """New bands of a series as its last one; other features as always."""
    robot, problem = arm.rows.problem.space.robot, arm.rows.problem
    small = Design(problem, (FourierSeries(robot, 2), ScaledJoints(robot)))
    large = Design(problem, (GravityTorques(robot), ScaledJoints(robot), FourierSeries(robot, 4)))
    sizes = torch.tensor([0.5, 2.0, 1.0, 3.0, 1e-4, 2e-4, 5e-4], dtype=torch.float64)
    found = large.prior_with_scales_of(small, replace(small.prior((1.0,) * 4), group_scales=sizes))
    expected = [0.5, 2.0, 1.0, 3.0, FIRST_SIZE, 5e-4, 1e-4, 2e-4, 2e-4, 2e-4]
    assert_close(found.group_scales, torch.tensor(expected, dtype=torch.float64), rtol=1e-7)
    assert_close(found.unit_precision, large.prior((1.0,) * 4).unit_precision)


def test_columns_that_a_joint_does_not_have_get_no_unknown(arm: LinearisedArm) -> None:
    robot = arm.rows.problem.space.robot
    gravity = GravityTorques(robot)
    design = Design(arm.rows.problem, (gravity,))
    assert not bool(gravity.used.all())
    assert design.unknowns == design.active_count + int(gravity.used.sum())
    columns = design.columns(arm.rows.values[0], slice(0, 5))
    assert columns.shape == (5, 3, design.unknowns)
    q = arm.rows.problem.q[arm.rows.values[0].row[:5]]
    weight = torch.randn(gravity.used.shape, generator=torch.Generator().manual_seed(0)).double()
    delta = (gravity.columns(JointState(q)) * weight * gravity.used).sum(-1)
    expected = (arm.rows.values[0].joint_derivatives[:5] @ delta[..., None])[..., 0]
    assert_close(columns[..., design.weights_of(0)] @ weight[gravity.used], expected, atol=1e-13)


def test_prior_has_a_size_for_every_class_and_every_group_of_weights(arm: LinearisedArm) -> None:
    robot, problem = arm.rows.problem.space.robot, arm.rows.problem
    design = Design(problem, features(robot, 3))
    prior = design.prior((0.5, 2.0, 1.0, 3.0))
    assert prior.geometric_class_count == 4
    assert_close(
        prior.group_scales, torch.tensor([0.5, 2.0, 1.0, 3.0, *[FIRST_SIZE] * 5]).double(), rtol=1e-7
    )
    active = slice(0, design.active_count)
    expected = problem.precision[problem.active] / prior.group_scales[problem.prior_group].square()
    assert_close(prior.precision[active], expected, rtol=1e-14)
    assert prior.group[design.weights_of(0)].unique().tolist() == [4]
    assert prior.group[design.weights_of(1)].unique().tolist() == [5]
    assert prior.group[design.weights_of(2)].view(4, 6).tolist() == [[6, 7, 8] * 2] * 4


def test_weights_of_a_prismatic_joint_are_scaled_by_the_reach(arm: LinearisedArm) -> None:
    robot = arm.rows.problem.space.robot
    design = Design(arm.rows.problem, (FourierSeries(robot, 1),))
    base = design.prior((1.0,) * 4).unit_precision[design.weights_of(0)].view(4, 2)
    turning = torch.tensor(robot.revolute)
    assert_close(base[turning], torch.ones(3, 2))
    assert_close(base[~turning], torch.full((1, 2), robot.reach**-2), rtol=1e-6)
