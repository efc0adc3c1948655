"""The search for features: what is tried after what, and what is kept."""

import itertools
from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.linearised import LinearisedArm, linearised, random_joints, tracker_data

from pisigma.calibration.hybrid.search import CLEAR_EVIDENCE, CLEAR_GAIN, MAX_USUAL_SHARE, FeatureSearch
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.gravity_torques import GravityTorques
from pisigma.joint_correction.input_products import InputProducts
from pisigma.measurement.conditions import JointState
from pisigma.robot import Robot

ROBOT = Robot.load("rb5")
PRODUCTS = InputProducts(ROBOT)
SERIES = [FourierSeries(ROBOT, count) for count in (2, 4, 6)]
SMALL = GravityTorques(ROBOT)


def rows_of(delta: torch.Tensor, q: torch.Tensor, noise: float = 3e-5) -> LinearisedArm:
    return linearised(ROBOT, tracker_data(ROBOT, q, delta, noise))


def search_of(arm: LinearisedArm, said: list[str] | None = None) -> FeatureSearch:
    progress = (lambda what: None) if said is None else said.append
    return FeatureSearch(arm.rows, arm.noise, arm.prior_scale, [SMALL, SERIES[-1], PRODUCTS], progress)


def product(q: torch.Tensor) -> torch.Tensor:
    """What the second joint is off by [rad]."""
    return 6e-4 * q[:, 2].sin() * q[:, 4].cos()


@pytest.fixture(scope="module")
def series() -> LinearisedArm:
    """Joints are off by four harmonics."""
    q = random_joints(ROBOT, 120, 0)
    return rows_of(2e-4 * (4 * q).sin(), q)


@pytest.fixture(scope="module")
def products() -> LinearisedArm:
    """The second joint is off by a product of what two others do."""
    q = random_joints(ROBOT, 150, 0)
    return rows_of(product(q)[:, None] * (torch.arange(6) == 1), q)


def test_geometry_is_the_first_line_and_the_unit(series: LinearisedArm) -> None:
    search = search_of(series)
    (line,) = search.trials
    assert (line.name, line.held_out_ratio, line.is_best_so_far) == ("geometry", 1.0, True)
    assert search.fit_without_features.name == "geometry"
    assert line.unknowns == search.fit_without_features.design.active_count
    alone = series.fitted(())
    assert_close(search.fit_without_features.posterior.log_evidence, alone.posterior.log_evidence, atol=0.5)


def test_larger_series_are_tried_until_the_evidence_is_clearly_against_them(series: LinearisedArm) -> None:
    said: list[str] = []
    search = search_of(series, said)
    best = search.select_features(SERIES, [SMALL], [PRODUCTS])
    assert best.name.endswith("series 4")
    kept = [line for line in search.trials if line.is_best_so_far]
    assert kept[-1].name == best.name
    assert kept[-1].held_out_ratio < 0.4
    assert all(b.log_evidence > a.log_evidence + CLEAR_EVIDENCE for a, b in itertools.pairwise(kept))
    assert [line.name for line in search.trials[1:]] == said


def test_products_come_last_and_stay_where_they_help(products: LinearisedArm) -> None:
    search = search_of(products)
    best = search.select_features(SERIES[:1], [SMALL], [PRODUCTS])
    assert best.name.endswith("products")
    assert search.trials[-1].is_best_so_far
    assert search.trials[-1].held_out_ratio < 0.6
    moved = best.design.correction(best.posterior.x, search.rows.problem.state)[:, 1]
    q = search.rows.problem.q
    columns = torch.cat(
        [torch.ones(len(q), 1).double(), q.sin(), q.cos()], 1
    )  # the geometry has these as well
    expected = product(q)
    off, whole = (
        (values - columns @ torch.linalg.lstsq(columns, values).solution).norm()
        for values in (moved - expected, expected)
    )
    assert float(off / whole) < 0.3


def test_products_have_to_gain_more_than_the_scatter(products: LinearisedArm, monkeypatch) -> None:
    """More evidence alone does not keep them."""
    kept = search_of(products).select_features(SERIES[:1], [SMALL], [PRODUCTS])
    search = search_of(products)
    without = search.select_features(SERIES[:1], [SMALL])
    gain = kept.gain_in_standard_errors(without)
    assert gain > CLEAR_GAIN
    assert without.gain_in_standard_errors(kept) < -CLEAR_GAIN
    monkeypatch.setattr("pisigma.calibration.hybrid.search.CLEAR_GAIN", gain + 1e-6)
    assert search.select_features(SERIES[:1], [SMALL], [PRODUCTS]).name == without.name
    assert search.trials[-1].log_evidence > without.posterior.log_evidence + CLEAR_EVIDENCE


def test_few_rows_are_fitted_with_all_features_from_usual_sizes() -> None:
    """One after the other they do not stand out from the noise that the others leave."""
    q = random_joints(ROBOT, 26, 7)
    weights = torch.randn(SMALL.used.shape, generator=torch.Generator().manual_seed(0)) * SMALL.used
    gravity = 2e-4 * (SMALL.columns(JointState(q)) * weights).sum(-1)
    gears = torch.stack([2e-4 * (k * q + torch.arange(6) * k).sin() for k in (1, 2, 6)]).sum(0)
    search = search_of(rows_of(gravity + gears, q))
    best = search.select_features(SERIES, [SMALL])
    assert best.name == "gravity + series 6"
    assert best.max_effective_share == MAX_USUAL_SHARE
    *before, together, wider = search.trials
    assert not wider.is_best_so_far  # the geometry is nominal here
    assert together.log_evidence > max(line.log_evidence for line in before) + CLEAR_EVIDENCE
    assert together.held_out_ratio < 0.7 * min(line.held_out_ratio for line in before if line.is_best_so_far)


def test_what_does_not_help_leaves_the_geometry() -> None:
    q = random_joints(ROBOT, 80, 4)
    search = search_of(rows_of(torch.zeros_like(q), q))
    best = search.select_features(SERIES, [SMALL], [PRODUCTS])
    assert best is search.fit_without_features
    assert not any(line.is_best_so_far for line in search.trials[1:])


def test_a_fit_starts_from_the_sizes_and_the_noise_of_another(series: LinearisedArm) -> None:
    search = search_of(series)
    near, held_out = search.fit_features([SERIES[1]])
    again, held_out_again = search.fit_features([SERIES[1]], near)
    assert_close(held_out_again, held_out, rtol=0.02)
    assert abs(again.posterior.log_evidence - near.posterior.log_evidence) < 2.0
    sizes = torch.full((ROBOT.dof,), 1e-6, dtype=torch.float64)
    given, _ = search.fit_features([SERIES[1], PRODUCTS], near, sizes)
    assert given.design.unknowns == near.design.unknowns + PRODUCTS.used.numel()
    assert given.posterior.log_evidence > near.posterior.log_evidence - 2.0


def test_many_groups_are_held_out_in_few_folds(
    series: LinearisedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    every = search_of(series).select_features(SERIES[:2], [SMALL])
    monkeypatch.setattr("pisigma.calibration.hybrid.search.FEW_GROUPS", 50)
    search = search_of(replace(series))
    assert [len(fold) for fold in search._folds] == [30] * 4
    assert search.select_features(SERIES[:2], [SMALL]).name == every.name
