"""Normal equations of chosen columns, their prior, and smaller designs as parts of larger ones."""

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, drawn_joints, linearised, tracker_data

from pisigma.hybrid.design import Design, sum_up, weighted_columns
from pisigma.hybrid.evidence import FIRST_SIZE
from pisigma.joint_correction.feature import AbstractFeature
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.shared_features import ScaledJoints
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot


@pytest.fixture(scope="module")
def arm() -> LinearisedArm:
    robot = Robot.load("kiro3")
    q = drawn_joints(robot, 60, 0)
    delta = 1e-4 * torch.sin(3 * q)
    return linearised(robot, tracker_data(robot, q, delta, 1e-5, turn_noise=1e-5, several=True))


def features(robot: Robot, harmonics: int) -> tuple[AbstractFeature, ...]:
    return ScaledJoints(robot), GravityTorques(robot), FourierSeries(robot, harmonics)


def test_sums_are_those_of_all_columns_at_once(arm: LinearisedArm, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever fits into a chunk; rows count by the square of their root."""
    monkeypatch.setattr("pisigma.hybrid.design.CHUNK", 17)
    design = Design(arm.rows.problem, features(arm.rows.problem.space.robot, 3))
    weight = torch.linspace(0.5, 2.0, 60, dtype=torch.float64)
    values = [sensor.weighted(weight) for sensor in arm.rows.values]
    here = 1e-4 * torch.randn(design.unknowns, generator=torch.Generator().manual_seed(1)).double()
    found = sum_up(design, values, here)
    for k, (sensor, X, y) in enumerate(zip(values, *weighted_columns(design, values, here), strict=True)):
        columns = design.columns(sensor, slice(None))
        assert_close(X, columns * weight.sqrt()[:, None, None], atol=1e-14)
        assert_close(y, (sensor.residual + columns @ here) * weight.sqrt()[:, None], atol=1e-14)
        scale = float(columns.abs().max()) ** 2 * 60
        assert_close(found.normal[k], torch.einsum("rci,rcj->ij", X, X), atol=1e-13 * scale)
        assert_close(found.descent[k], torch.einsum("rci,rc->i", X, y), atol=1e-13 * scale)
        assert_close(found.square[k], float(y.square().sum()), rtol=1e-12)
    assert found.count == (180.0, 180.0)


def test_sums_count_from_nominal_or_from_where_the_values_were_linearised(arm: LinearisedArm) -> None:
    design = Design(arm.rows.problem, ())
    nowhere, zero = (
        sum_up(design, arm.rows.values, here) for here in (None, torch.zeros(design.unknowns).double())
    )
    assert_close(nowhere.descent, zero.descent)
    assert nowhere.square == zero.square
    there = sum_up(design, arm.rows.values, arm.rows.here)
    moved = zero.descent + zero.normal @ arm.rows.here
    assert_close(there.descent, moved, atol=1e-12 * float(zero.normal.abs().max()))


@pytest.mark.parametrize("chosen", [(0,), (1, 2), (2,), (2, 0), ()])
def test_sums_of_a_smaller_design_are_a_part_of_those_of_a_larger(
    arm: LinearisedArm, chosen: tuple[int, ...]
) -> None:
    """Of fewer features, in another order, and of a series with fewer harmonics."""
    robot = arm.rows.problem.space.robot
    large = Design(arm.rows.problem, features(robot, 7))
    small = Design(arm.rows.problem, tuple(features(robot, 3)[k] for k in chosen))
    whole, part = (sum_up(design, arm.rows.values, arm.rows.start(design)) for design in (large, small))
    places = large.indices(small.features)
    assert len(places) == len(set(places.tolist())) == small.unknowns
    found = whole.select(places)
    assert_close(found.normal, part.normal, atol=1e-13 * float(part.normal.abs().max()))
    assert_close(found.descent, part.descent, atol=1e-13 * float(part.descent.abs().max()))


def test_columns_that_a_joint_does_not_have_get_no_unknown(arm: LinearisedArm) -> None:
    robot = arm.rows.problem.space.robot
    gravity = GravityTorques(robot)
    design = Design(arm.rows.problem, (gravity,))
    assert not bool(gravity.used.all())
    assert design.unknowns == design.active + int(gravity.used.sum())
    columns = design.columns(arm.rows.values[0], slice(0, 5))
    assert columns.shape == (5, 3, design.unknowns)
    q = arm.rows.problem.q[arm.rows.values[0].row[:5]]
    weight = torch.randn(gravity.used.shape, generator=torch.Generator().manual_seed(0)).double()
    delta = (gravity.columns(JointState(q)) * weight * gravity.used).sum(-1)
    expected = (arm.rows.values[0].joints[:5] @ delta[..., None])[..., 0]
    assert_close(columns[..., design.stretch(0)] @ weight[gravity.used], expected, atol=1e-13)


def test_prior_has_a_size_for_every_class_and_every_group_of_weights(arm: LinearisedArm) -> None:
    robot, problem = arm.rows.problem.space.robot, arm.rows.problem
    design = Design(problem, features(robot, 3))
    prior = design.prior((0.5, 2.0, 1.0, 3.0))
    assert prior.classes == 4
    assert_close(prior.sizes, torch.tensor([0.5, 2.0, 1.0, 3.0, *[FIRST_SIZE] * 5]).double(), rtol=1e-7)
    active = slice(0, design.active)
    expected = problem.precision[problem.active] / prior.sizes[problem.prior_group].square()
    assert_close(prior.precision[active], expected, rtol=1e-14)
    assert prior.group[design.stretch(0)].unique().tolist() == [4]
    assert prior.group[design.stretch(1)].unique().tolist() == [5]
    assert prior.group[design.stretch(2)].view(4, 6).tolist() == [[6, 7, 8] * 2] * 4
    assert not prior.fixed


def test_weights_of_a_sliding_joint_count_in_radians_times_the_reach(arm: LinearisedArm) -> None:
    robot = arm.rows.problem.space.robot
    design = Design(arm.rows.problem, (FourierSeries(robot, 1),))
    base = design.prior((1.0,) * 4).base[design.stretch(0)].view(4, 2)
    turning = torch.tensor(robot.revolute)
    assert_close(base[turning], torch.ones(3, 2))
    assert_close(base[~turning], torch.full((1, 2), robot.reach**-2), rtol=1e-6)
