"""The chosen model on all rows: linearised anew until it settles, and what is uncertain in held factors."""

import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import product_values
from testing.linearised import drawn_joints, tracker_data

from pisigma.hybrid.alternating_products import AlternatingProducts
from pisigma.hybrid.calibrator import HybridCalibrator
from pisigma.hybrid.refinement import Refined, refine, with_all_factors
from pisigma.identification.calibrator import GeometricCalibrator
from pisigma.identification.problem.loss import HampelLoss
from pisigma.kinematics.forward import forward_kinematics
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot

ROBOT = Robot.load("rb5")


@pytest.fixture(scope="module", params=[(), (2, 2)])
def refined(request: pytest.FixtureRequest) -> Refined:
    """Large joint errors, so that one linearisation is not enough; with product units and without."""
    q = drawn_joints(ROBOT, 150, 0)
    delta = 4e-3 * torch.sin(q) + 3e-3 * (q.sin() * q.cos().roll(1, 1))
    calibrator = HybridCalibrator(GeometricCalibrator(ROBOT), harmonics=(2,), orders=())
    solved = calibrator.geometric.solve(tracker_data(ROBOT, q, delta, 3e-5))
    additive = calibrator._chosen(solved, lambda what: None)[1]
    return refine(solved, additive, request.param, HampelLoss())


def test_residuals_at_the_solution_are_those_of_the_nonlinear_model(refined: Refined) -> None:
    rows, problem = refined.rows, refined.rows.problem
    assert refined.rounds >= 2
    (values,) = rows.values
    change = rows.start(refined.design) - refined.posterior.x
    linear = values.residual + refined.design.columns(values, slice(None)) @ change
    moved = problem.q + refined.correction(problem.q)
    dh, bases, tools = problem.space.split(refined.point)
    robot = ROBOT.with_geometry(dh=dh.numpy(), base=bases[0].numpy(), tool=tools[0].numpy())
    predicted = forward_kinematics(robot, moved)[:, :3, 3]
    measured = problem.sensors[0].measured.t()  # type: ignore[attr-defined]
    assert_close((measured - predicted)[values.row], linear, atol=2e-7)


def test_no_row_is_left_worse_than_noise_and_model_allow(refined: Refined) -> None:
    products = len(refined.correction.orders)
    assert (refined.posterior.noise[0] < 6e-5) == bool(products)
    assert 0 < refined.effective < refined.design.unknowns


def test_held_factors_are_uncertain_too(refined: Refined) -> None:
    """What they change is the derivative of the products by them, and nothing moves at the solution."""
    whole = with_all_factors(refined)
    if not refined.correction.orders:
        assert whole is refined
        return
    held, other = whole.design.features[-2], whole.design.features[-1]
    assert isinstance(held, AlternatingProducts)
    assert isinstance(other, AlternatingProducts)
    assert sorted((*held.free, *other.free)) == [0, 1, 2, 3]
    q = drawn_joints(ROBOT, 10, 5)
    factors = other.factors
    weights = factors[:, list(other.free)].flatten()
    expected = product_values(ROBOT, factors, (2, 2), q)
    assert_close((other.columns(JointState(q)) * weights.view(6, -1)).sum(-1), expected, atol=1e-12)
    assert_close(expected, refined.correction(q) - _additive(refined, q), atol=1e-12)
    size = refined.design.unknowns
    assert whole.design.unknowns == size + len(weights)
    values = refined.rows.values[0]
    X = whole.design.columns(values, slice(0, 40))
    more = ((X @ whole.posterior.covariance) * X).sum(-1)
    less = ((X[..., :size] @ refined.posterior.covariance) * X[..., :size]).sum(-1)
    assert float((more / less).min()) > 0.99
    assert float((more / less).median()) > 1.02


def _additive(refined: Refined, q: torch.Tensor) -> torch.Tensor:
    made = refined.correction
    parts = [
        (chosen.columns(JointState(q)) * weight).sum(-1)
        for chosen, weight in zip(made.features, made.linear, strict=True)
    ]
    return torch.stack(parts).sum(0)
