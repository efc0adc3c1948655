"""The chosen model on all rows: linearised again until convergence, and written as a network."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import random_joints, tracker_data

from pisigma.calibration.geometric.calibrator import GeometricCalibrator
from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.calibration.hybrid.design import LinearisedRows
from pisigma.calibration.hybrid.refinement import RefinedFit, linearise_rows, refine
from pisigma.calibration.hybrid.search import FeatureChoice, FeatureFit
from pisigma.measurement.conditions import JointState
from pisigma.measurement.groups import held_out_groups
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

ROBOT = Robot.load("rb5")
ROWS = 260


@pytest.fixture(scope="module", params=[False, True], ids=["additive", "products"])
def refined(request: pytest.FixtureRequest) -> RefinedFit:
    """Large joint errors, so that one linearisation is not enough for products, which are chosen last."""
    q = random_joints(ROBOT, ROWS, 0)
    delta = 4e-3 * q.sin() + 3e-3 * (2 * q).cos()
    if request.param:
        delta = delta + 1e-2 * q.sin() * q.cos().roll(1, 1)
    calibrator = HybridCalibrator(GeometricCalibrator(ROBOT), harmonics=(2,), products=request.param)
    solved = calibrator.geometric_calibrator.solve(tracker_data(ROBOT, q, delta, 3e-5))
    group = held_out_groups(solved.setup.measurements)
    choice = calibrator._chosen(solved, group, lambda what: None)
    return refine(solved.problem, group, choice)


def test_residuals_at_the_solution_are_those_of_the_nonlinear_model(refined: RefinedFit) -> None:
    rows, problem = refined.rows, refined.rows.problem
    assert refined.rounds >= (2 if refined.correction.orders else 1)
    (values,) = rows.values
    linear = values.residual - refined.design.columns(values, slice(None)) @ refined.posterior.x
    moved = problem.q + refined.correction(problem.q)
    dh, bases, tools = problem.space.split(refined.point)
    robot = ROBOT.with_geometry(dh=dh.numpy(), base=bases[0].numpy(), tool=tools[0].numpy())
    predicted = forward_kinematics(robot, moved)[:, :3, 3]
    measured = problem.sensors[0].measured.t()  # type: ignore[attr-defined]
    assert_close((measured - predicted)[values.row], linear, atol=2e-7)


def test_no_row_is_left_worse_than_noise_and_model_allow(refined: RefinedFit) -> None:
    assert 2e-5 < refined.posterior.noise[0] < 4e-5
    assert 0 < refined.posterior.effective_unknowns < refined.design.unknowns


def test_the_network_predicts_what_the_design_does(refined: RefinedFit) -> None:
    """Products of inputs as product units of order 2, half as many as a joint has inputs at most."""
    q, design = random_joints(ROBOT, 20, 5), refined.design
    expected = design.correction(refined.posterior.x, JointState(q))
    assert_close(refined.correction(q), expected, atol=1e-13)
    orders, names = refined.correction.orders, [chosen.name for chosen in refined.correction.features]
    assert "products" not in names
    assert set(orders) <= {2}
    assert len(orders) <= 12
    assert bool(orders) == any(chosen.name == "products" for chosen in design.features)


def chosen_as(refined: RefinedFit, rows: LinearisedRows) -> FeatureChoice:
    """A choice that came to a solution on some rows."""
    fitted = FeatureFit(refined.design, refined.posterior)
    return FeatureChoice(rows, fitted, fitted, ())


def test_a_solution_that_has_settled_is_not_linearised_again(refined: RefinedFit) -> None:
    again = refine(refined.rows.problem, refined.rows.group, chosen_as(refined, refined.rows))
    assert again.rounds == 1
    assert again.rows is refined.rows
    assert_close(again.point, refined.point)


def test_rows_on_which_nothing_was_chosen_are_fitted_as_well(refined: RefinedFit) -> None:
    """Chosen on every other row, it is fitted to all."""
    problem = refined.rows.problem
    half = torch.arange(0, ROWS, 2)
    rows = linearise_rows(
        replace(refined.design, problem=problem.select(half)),
        refined.posterior.x,
        10.0,
        torch.arange(ROWS // 2),
    )
    found = refine(problem, refined.rows.group, chosen_as(refined, rows))
    assert found.rounds >= 2
    assert len(found.rows.values[0].row) == len(refined.rows.values[0].row)
