"""Normal equations summed by pairs of joints against all columns at once, and what is solved from them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.dense_regression import DenseRegression
from testing.linearised import linearised, random_joints, tracker_data
from testing.posteriors import assert_same_posterior
from testing.regression_cases import CASES, poses, several_targets
from torch import Tensor

from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.regression import NormalEquations
from pisigma.files.errors import IdentificationError
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.input_products import InputProducts
from pisigma.robot import Robot


def assert_same_sums(found: NormalEquations, expected: DenseRegression) -> None:
    """In units of the columns' lengths."""
    assert found.sensors == expected.sensors
    for k in range(len(found.sensors)):
        X, y = expected.X[expected.sensor == k], expected.y[expected.sensor == k]
        length = X.norm(dim=0).clamp(min=1e-12)
        assert_close(
            found.normal[k] / length / length[:, None], X.t() @ X / length / length[:, None], atol=1e-12
        )
        assert_close(found.descent[k] / length, X.t() @ y / length, atol=1e-12 * float(y.norm()) + 1e-300)
        assert_close(found.squared_values[k], float(y.square().sum()), rtol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_sums_are_those_of_all_columns_at_once(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever fits into a chunk."""
    case = CASES[name]()
    assert_same_sums(NormalEquations.from_rows(case.design, case.rows), case.dense)
    monkeypatch.setattr("pisigma.calibration.hybrid.design.CHUNK", 7)
    assert_same_sums(NormalEquations.from_rows(case.design, case.rows), case.dense)


def test_the_cases_are_what_they_are_for() -> None:
    """Sensors with one row, with two sides and with rows that count differently; columns that are not used."""
    values = {one.name: one for one in CASES["all kinds"]().rows.values}
    assert len(values["socket distance"].row) == 1
    assert values["socket distance"].are_values_given
    assert len(values["pair"].row_derivatives) == 2
    assert len(poses().rows.values[0].weight_root.unique()) > 20
    assert not bool(poses().design.features[1].used.all())
    assert several_targets().rows.values[0].repeat_variance_factor > 1.2
    assert len(CASES["few values"]().dense.y) < CASES["few values"]().design.unknowns / 4


@pytest.mark.parametrize("name", CASES)
def test_posterior_is_that_of_the_dense_problem(name: str) -> None:
    case = CASES[name]()
    found = NormalEquations.from_rows(case.design, case.rows)
    assert_same_posterior(found, case.dense, case.prior, case.noise, case.exactness)


@pytest.mark.parametrize("name", CASES)
def test_sums_of_a_smaller_design_are_a_part_of_those_of_a_larger(name: str) -> None:
    """Of fewer features, and of a series with fewer harmonics."""
    case = CASES[name]()
    small = Design(case.rows.problem, case.smaller)
    places = case.design.indices(case.smaller)
    assert len(places) == len(set(places.tolist())) == small.unknowns
    found = NormalEquations.from_rows(case.design, case.rows).select(small)
    assert found.design is small
    assert_same_sums(found, DenseRegression.from_rows(small, case.rows))
    assert_same_sums(found, case.dense.select(places))


@pytest.mark.parametrize("name", CASES)
def test_sums_with_another_feature_are_those_of_all_columns_at_once(name: str) -> None:
    """Of some of the features that were there, one of which may be smaller, and the new one."""
    case = CASES[name]()
    features = [one for one in case.design.features if one.name != case.smaller[0].name]
    first = NormalEquations.from_rows(Design(case.rows.problem, tuple(features)), case.rows)
    design = Design(case.rows.problem, (*features[:1], case.smaller[0]))
    assert_same_sums(first.with_feature(design), DenseRegression.from_rows(design, case.rows))


@pytest.mark.parametrize("name", CASES)
def test_sums_without_some_groups_are_those_of_the_others(name: str) -> None:
    """What is certain stays."""
    case = CASES[name]()
    groups = torch.cat(case.folds[1:])
    found, expected = (
        NormalEquations.from_rows(case.design, case.rows).without_groups(groups),
        case.dense.without_groups(groups),
    )
    assert_close(
        np.array([one.values for one in found.sensors]),
        np.array([one.values for one in expected.sensors]),
        rtol=1e-12,
    )
    for k in range(len(found.sensors)):
        X, y = expected.X[expected.sensor == k], expected.y[expected.sensor == k]
        whole = case.dense.X[case.dense.sensor == k].norm(dim=0).clamp(min=1e-12)
        assert_close(found.normal[k] / whole / whole[:, None], X.t() @ X / whole / whole[:, None], atol=1e-12)
        assert_close(found.descent[k] / whole, X.t() @ y / whole, atol=1e-11 * case.noise[k])


def with_sums(normal: Tensor, descent: Tensor) -> NormalEquations:
    """Return normal equations of one sensor with the given sums instead of those of rows."""
    whole = NormalEquations.from_rows(poses().design, poses().rows)
    return replace(
        whole, normal=normal[None], descent=descent[None], squared_values=(1.0,), sensors=whole.sensors[:1]
    )


def test_equal_columns_without_a_prior_are_still_solved() -> None:
    generator = torch.Generator().manual_seed(0)
    X, y = (torch.randn(30, *shape, generator=generator, dtype=torch.float64) for shape in ((5,), ()))
    twice = torch.cat([X, 1e-6 * X[:, :1]], 1)
    flat = replace(
        poses().prior,
        unit_precision=torch.zeros(6).double(),
        group=torch.zeros(6, dtype=torch.int64),
        group_scales=torch.ones(1).double(),
    )
    x = with_sums(twice.t() @ twice, twice.t() @ y).solve(flat, (1.0,)).x
    assert_close(twice @ x, X @ torch.linalg.lstsq(X, y).solution, atol=1e-5)


def test_values_that_are_not_finite_are_refused() -> None:
    sums = NormalEquations.from_rows(poses().design, poses().rows)
    broken = replace(sums, normal=sums.normal * float("nan"))
    with pytest.raises(IdentificationError):
        broken.solve(poses().prior, poses().noise)


def test_initial_sizes_nearly_reach_the_gain_of_the_whole_fit() -> None:
    """With the other sizes and the noise held it is a lower bound, and the sizes are those found so."""
    robot = Robot.load("rb5")
    q = random_joints(robot, 120, 0)
    delta = 6e-5 * q[:, 1:2].sin() * q[:, 2:3].cos() * torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0, 0.0]).double()
    arm = linearised(robot, tracker_data(robot, q, delta, 3e-5))
    products = InputProducts(robot)
    design = Design(arm.rows.problem, (GravityTorques(robot),))
    largest = NormalEquations.from_rows(Design(arm.rows.problem, (*design.features, products)), arm.rows)
    own = largest.select(design)
    before = own.maximise_evidence(design.prior(arm.prior_scale), arm.noise, 400, 1e-6)
    gain, sizes = largest.evidence_gain(before, design, products)
    assert sizes is not None
    assert len(sizes) == robot.dof
    held = largest.design.prior_with_scales_of(design, before.prior)
    held = replace(held, group_scales=torch.cat([before.prior.group_scales, sizes]))
    there = largest.solve(held, before.noise)
    assert_close(gain, there.log_evidence - before.log_evidence, atol=1e-3)
    full = largest.maximise_evidence(held, before.noise, 400, 1e-6).log_evidence - before.log_evidence
    assert gain <= full + 1e-3
    assert gain > 0.7 * full
    assert gain > 5.0
