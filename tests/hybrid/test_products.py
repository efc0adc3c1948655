"""Alternating least squares on product units: held sizes, exact models, and the unit of order 1 beside them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import Fitted, LinearisedArm, drawn_joints, linearised, tracker_data

from pisigma.hybrid.alternating_products import AlternatingProducts, normalised
from pisigma.hybrid.design import sum_up
from pisigma.hybrid.evidence import maximise_evidence, solve_mean
from pisigma.hybrid.products import ROUNDS, FittedProducts, ProductFit
from pisigma.hybrid.refinement import network
from pisigma.identification.prediction import predicted_poses
from pisigma.identification.problem.setup import identified_geometry
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot import Robot

SERIES = 2


def product_model(robot: Robot, size: float, seed: int = 5) -> JointCorrection:
    """One unit of two factors per joint [rad], on sines and cosines of all joints."""
    made = JointCorrection(robot, (), (2,))
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        made.weight.copy_(torch.randn(made.weight.shape, generator=generator, dtype=torch.float64))
        made.weight.mul_(size**0.5 / made.weight.norm(dim=-1, keepdim=True) * 2)
    return made.requires_grad_(False)


def fit_to(arm: LinearisedArm, fitted: Fitted) -> ProductFit:
    start = arm.rows.start(fitted.design)
    return ProductFit(fitted.design, arm.rows.values, start, fitted.posterior, fitted.sums)


def rms(arm: LinearisedArm, found: FittedProducts | Fitted) -> float:
    """Of the residuals of positions [m]."""
    (values,) = arm.rows.values
    change = arm.rows.start(found.design) - found.posterior.x
    left = values.residual + found.design.columns(values, slice(None)) @ change
    return float(left.square().sum(1).mean().sqrt())


@pytest.fixture(scope="module")
def exact() -> tuple[LinearisedArm, Fitted]:
    """A robot whose joints are off by products, measured without noise to speak of."""
    robot = Robot.load("rb5")
    q = drawn_joints(robot, 300, 0)
    data = tracker_data(robot, q, product_model(robot, 2e-5)(q), noise=1e-7)
    arm = linearised(robot, data)
    return arm, arm.fitted((FourierSeries(robot, SERIES),))


def test_an_exact_product_model_is_recovered(exact: tuple[LinearisedArm, Fitted]) -> None:
    """Residuals and new poses far below what an additive model leaves."""
    arm, fitted = exact
    additive = rms(arm, fitted)
    found = fit_to(arm, fitted).fit((2,))
    assert additive > 1e-5
    assert rms(arm, found) < 0.05 * additive
    robot = arm.rows.problem.space.robot
    new = drawn_joints(robot, 1000, 77)
    true, own = product_model(robot, 2e-5)(new), network(found.design, found.posterior)(new)
    # What belongs to the geometry as well, such as a constant or a multiple of sin and cos, is not told apart.
    columns = torch.cat([torch.ones(1000, 1), new.sin(), new.cos()], 1).double()
    left = [values - columns @ torch.linalg.lstsq(columns, values).solution for values in (true, own)]
    ratio = (left[1] - left[0]).square().mean(0) / left[0].square().mean(0)
    assert float(ratio[1:5].max().sqrt()) < 0.2


def test_with_sizes_held_all_unknowns_are_those_of_the_whole_solve() -> None:
    """Geometry and series are taken out of the normal equations, and come back as if they never were."""
    robot = Robot.load("rb5")
    q = drawn_joints(robot, 200, 0)
    delta = product_model(robot, 1e-4)(q)
    arm = linearised(robot, tracker_data(robot, q, delta, 3e-5, turn_noise=1e-4, several=True))
    fitted = arm.fitted((FourierSeries(robot, SERIES),))
    fit = fit_to(arm, fitted)
    factors = torch.randn(6, 4, 13, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    held = AlternatingProducts(robot, (2, 2), normalised(factors), 0)
    fit._reduce(fitted.posterior)
    posterior = fit._completed(*fit._reduced(held, fit._first_prior(held), 0))
    design = replace(fitted.design, features=(*fitted.design.features, held))
    sums = sum_up(design, arm.rows.values, arm.rows.start(design))
    whole = solve_mean(sums, posterior.prior, fitted.posterior.noise)
    for values in arm.rows.values:
        columns = design.columns(values, slice(None))
        assert_close(columns @ posterior.x, columns @ whole, atol=1e-10)
    weights = design.stretch(1)
    scale = float(whole[weights].abs().max())
    assert scale > 1e-5
    assert_close(posterior.x[weights], whole[weights], atol=1e-6 * scale)
    count = fitted.design.unknowns
    assert_close(posterior.prior.precision[:count], fitted.posterior.prior.precision)


def test_quick_fits_leave_sizes_and_noise_of_the_rest_as_they_were(
    exact: tuple[LinearisedArm, Fitted],
) -> None:
    """Without updates at the end; geometry and series then are the best beside the products' weights."""
    arm, fitted = exact
    found = fit_to(arm, fitted).fit((2, 2), final_iterations=0)
    assert found.units.turn == ROUNDS - 1
    design, x = found.design, found.posterior.x
    sums = sum_up(design, arm.rows.values, arm.rows.start(design))
    precision = found.posterior.prior.precision
    slope = (sums.descent - sums.normal @ x)[0] / found.posterior.noise[0] ** 2 - precision * x
    size = (sums.normal[0].diagonal() / found.posterior.noise[0] ** 2 + precision).sqrt()
    count = fitted.design.unknowns
    assert_close((slope / size)[:count], torch.zeros(count), atol=1e-2)


def test_at_the_end_all_sizes_and_the_noise_are_estimated(exact: tuple[LinearisedArm, Fitted]) -> None:
    arm, fitted = exact
    fit = fit_to(arm, fitted)
    held, free = fit.fit((2,), 0), fit.fit((2,))
    assert free.posterior.noise[0] < 0.6 * held.posterior.noise[0]
    design = free.design
    sums = sum_up(design, arm.rows.values, arm.rows.start(design))
    again = maximise_evidence(sums, free.posterior.prior, free.posterior.noise, 3)
    assert again.log_evidence >= free.posterior.log_evidence - 1e-3
    assert free.factors.shape == (6, 2, fit.inputs)


def test_more_unknowns_than_a_few_are_fitted_with_sizes_held_until_the_end(
    exact: tuple[LinearisedArm, Fitted], monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, fitted = exact
    monkeypatch.setattr("pisigma.hybrid.products.QUICK", 0)
    found = fit_to(arm, fitted).fit((2,))
    assert rms(arm, found) < 0.3 * rms(arm, fitted)


def test_the_network_predicts_what_the_design_does(exact: tuple[LinearisedArm, Fitted]) -> None:
    arm, fitted = exact
    found = fit_to(arm, fitted).fit((2, 3), 0)
    made = network(found.design, found.posterior)
    assert made.orders == (2, 3)
    (values,) = arm.rows.values
    delta = made(arm.rows.problem.q)
    expected = (values.joints @ delta[values.row][..., None])[..., 0]
    columns = found.design.columns(values, slice(None))[..., found.design.active :]
    assert_close(columns @ found.posterior.x[found.design.active :], expected, atol=1e-12)
    plain = network(fitted.design, fitted.posterior)
    assert plain.orders == ()
    weights = fitted.posterior.x[fitted.design.stretch(0)]
    assert_close(plain.linear[0].flatten(), weights)


def test_products_fitted_to_noise_alone_cost_little() -> None:
    """Shrunk by their prior, they stay below the noise; that they do not help is for the search to see."""
    robot = Robot.load("rb5")
    arm = linearised(robot, tracker_data(robot, drawn_joints(robot, 150, 3), noise=3e-5))
    fitted = arm.fitted((FourierSeries(robot, 1),))
    found = fit_to(arm, fitted).fit((2,))
    new = tracker_data(robot, drawn_joints(robot, 1000, 9))
    off = []
    for one in (fitted, found):
        problem = arm.rows.problem
        point = problem.nominal.index_add(0, problem.active, one.posterior.x[: one.design.active])
        known = identified_geometry(arm.setup, point)
        moved = replace(new, q=new.q + network(one.design, one.posterior)(new.q))
        T = predicted_poses(known.robot, known.bases, known.tools, moved)
        assert new.position is not None
        off.append(float((T[:, :3, 3] - new.position).square().sum(1).mean().sqrt()))
    assert off[1] < 3 * off[0]
    assert off[1] < 3**0.5 * 3e-5  # what one measured position is off
    units = found.units
    assert isinstance(units, AlternatingProducts)
    lengths = units.factors.norm(dim=-1).numpy()
    assert_close(lengths, np.ones_like(lengths), atol=1e-12)
