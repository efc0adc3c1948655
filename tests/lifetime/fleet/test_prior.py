"""Fleet priors, and what they gain for ten poses of another robot."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2
from testing.fleet_robots import INDIVIDUAL, NOMINAL, common_errors, rows_of
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.calibration.hybrid.noise import CalibrationNoise
from pisigma.estimation.covariance_root import CovarianceRoot
from pisigma.estimation.population import Population, expectation_maximisation, without_outliers
from pisigma.files.errors import FleetError
from pisigma.lifetime.fleet.prior import FleetConsistency, RobotEvidence, fleet_prior
from pisigma.lifetime.fleet.prior_summary import summarise_prior
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.settings.calibration import CalibrationSettings

ROBOTS = 8


@pytest.fixture(scope="module")
def prior():
    """Of eight robots, of which the last is of another type."""
    with no_type_checker():
        return fleet_prior("fleet", NOMINAL, [rows_of(k, 40, k, odd=k == ROBOTS - 1) for k in range(ROBOTS)])


def rms(errors):
    return float(errors["position"].square().sum(1).mean().sqrt())


def test_an_inconsistent_robot_is_named_and_excluded(prior):
    assert prior.inconsistent_robots == (ROBOTS - 1,)
    summary = summarise_prior(prior, [f"r{k}" for k in range(ROBOTS)])
    assert (summary.robots, summary.inconsistent_robots) == (ROBOTS - 1, ("r7",))
    assert "r7" in summary.warnings[0]


def test_shared_errors_are_estimated_or_stated_to_be_in_a_sum(prior):
    parameters = {
        one.name: one for one in summarise_prior(prior, [f"r{k}" for k in range(ROBOTS)]).parameters
    }
    true = dict(zip(prior.names, common_errors().flatten().tolist(), strict=True))
    alone = [name for name in true if not parameters[name].is_determined_only_in_sum]
    assert {"a_2", "a_3", "alpha_2", "alpha_3", "theta_3", "d_5"} <= set(alone)
    for name in alone:
        scale = 1e3 if parameters[name].unit == "mm" else np.rad2deg(1)
        assert abs(parameters[name].mean / scale - true[name]) < 4e-4, name


def test_the_prior_improves_a_calibration_with_ten_poses(prior):
    few, test = rows_of(50, 10, 1), rows_of(50, 300, 2, noise=0.0)
    with no_type_checker():
        begun = recalibrate(prior.model, few)
        without = calibrate(NOMINAL, few, CalibrationSettings(folds=0)).result
    assert begun.candidate_choice.kept != "scratch"
    assert begun.movements == ()
    assert rms(begun.adaptation.errors_of(test)) < 0.6 * rms(without.errors_of(test))


def test_a_robot_of_another_type_is_inconsistent_and_calibrated_from_scratch(prior):
    few = rows_of(60, 10, 3, odd=True)
    with no_type_checker():
        assert FleetConsistency.from_rows(prior.model, few).is_inconsistent
        assert not FleetConsistency.from_rows(prior.model, rows_of(61, 20, 4)).is_inconsistent
        begun = recalibrate(prior.model, few)
        without = calibrate(NOMINAL, few, CalibrationSettings(folds=0))
        fewer = recalibrate(prior.model, few.select(torch.arange(8)))
    assert begun.candidate_choice.kept == "scratch"
    assert begun.candidate_choice.rms["scratch"] is None
    assert np.array_equal(begun.model.calibrated.dh, without.model.calibrated.dh)
    assert fewer.candidate_choice.kept != "scratch"
    assert (
        fewer.summary.change_sentence
        == FleetConsistency.from_rows(prior.model, few.select(torch.arange(8))).sentence
    )
    # the prior is widened until it contains this robot
    root = CovarianceRoot(fewer.adaptation.problem.posterior.covariance_root)
    widened = replace(prior.model, uncertainty=replace(prior.model.uncertainty, covariance_root=root))
    with no_type_checker():
        assert not FleetConsistency.from_rows(widened, few.select(torch.arange(8))).is_inconsistent


def test_right_rows_of_a_robot_unlike_its_fleet_are_used(prior):
    """Its individual errors are five times those of the fleet."""
    rows = rows_of(81, 8, 81, individual=5 * INDIVIDUAL)
    with no_type_checker():
        begun = recalibrate(prior.model, rows)
    assert begun.summary.outliers == ()
    assert begun.adaptation.values.configuration.unique().numel() == rows.rows


def test_expectation_maximisation_finds_a_population():
    """Many robots, each of which sees its errors nearly exactly."""
    g = torch.Generator().manual_seed(0)
    mean, deviation = torch.tensor([1.0, -2.0]).double(), torch.tensor([0.5, 0.1]).double()
    x = mean + deviation * torch.randn(4000, 2, generator=g, dtype=torch.float64)
    evidence = [RobotEvidence(1e8 * torch.eye(2).double(), 1e8 * one, CalibrationNoise()) for one in x]
    start = Population(torch.zeros(2).double(), torch.eye(2).double(), 1)
    found = expectation_maximisation(evidence, start, torch.ones(2).double())
    assert (found.mean - mean).abs().max() < 0.03
    assert (found.covariance.diagonal().sqrt() / deviation - 1).abs().max() < 0.05


def test_the_prior_of_few_robots_is_wider():
    """One more than five is beyond their 95 % point in 19 %, as their scatter is uncertain, too; else in 31 %."""
    g = torch.Generator().manual_seed(0)
    beyond = []
    for _ in range(200):
        x = torch.randn(6, 2, generator=g, dtype=torch.float64)
        robots = [RobotEvidence(1e8 * torch.eye(2).double(), 1e8 * one, CalibrationNoise()) for one in x]
        off = x[:5] - x[:5].mean(0)
        population = Population(x[:5].mean(0), off.square().mean(0).diag(), 0).predictive_distribution(5)
        square, count = population.squared_distance(robots[5])
        beyond.append(chi2.sf(square, count) < 0.05)
    assert sum(beyond) < 0.2 * len(beyond)


def test_a_robot_without_information_does_not_count():
    g = torch.Generator().manual_seed(0)
    x = 0.3 * torch.randn(50, 2, generator=g, dtype=torch.float64)
    evidence = [RobotEvidence(1e6 * torch.eye(2).double(), 1e6 * one, CalibrationNoise()) for one in x]
    nothing = RobotEvidence(torch.zeros(2, 2).double(), torch.zeros(2).double(), CalibrationNoise())
    start = Population(torch.zeros(2).double(), torch.eye(2).double(), 1)
    few, many = (
        expectation_maximisation(those, start, torch.ones(2).double())
        for those in (evidence, [*evidence, nothing])
    )
    assert (few.mean - many.mean).abs().max() < 1e-4
    assert (few.covariance - many.covariance).abs().max() < 0.02


@pytest.mark.parametrize("odd", [0, 1, 6])
def test_similar_inconsistent_robots_do_not_mask_each_other(odd):
    g = torch.Generator().manual_seed(odd)
    x = torch.tensor([1.0, -2.0, 0.5]).double() + 0.2 * torch.randn(20, 3, generator=g, dtype=torch.float64)
    x[20 - odd :] += 3.0
    evidence = [RobotEvidence(1e4 * torch.eye(3).double(), 1e4 * one, CalibrationNoise()) for one in x]
    start = Population(torch.zeros(3).double(), 9 * torch.eye(3).double(), 2)
    population, found = without_outliers(evidence, start, 9 * torch.ones(3).double())
    assert found == tuple(range(20 - odd, 20))
    assert (population.covariance.diagonal().sqrt() < 0.5).all()


def test_few_robots_are_refused():
    with refused(FleetError, option="fleet", value=4):
        fleet_prior("fleet", NOMINAL, [rows_of(0, 20, 0)] * 4)
