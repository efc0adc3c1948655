"""Choice of the candidate of a recalibration by the errors of held-out rows."""

import math

import pytest
import torch
from testing.aged import original_model, rows_after_change
from testing.closeness import assert_close

from pisigma.calibration.hybrid.calibrator import HybridCalibrator
from pisigma.lifetime.recalibration.adaptation import adapt
from pisigma.lifetime.recalibration.candidates import MIN_RATIO, CandidateChoice, _decided, choose_candidate
from pisigma.lifetime.recalibration.recalibration_problem import recalibration_problem
from pisigma.model.model_posterior import ModelPosterior


def decided(**errors: list[float]) -> CandidateChoice:
    return _decided({name: torch.tensor(values).double() for name, values in errors.items()})


def test_the_recalibrated_model_is_kept_where_it_is_about_as_good():
    near = [0.99, 1.01] * 10
    scaled = {factor: [factor * error for error in near] for factor in (1.04, 1.06, 0.9)}
    assert decided(recalibrated=scaled[1.04], old=near, scratch=near).kept == "recalibrated"
    assert decided(recalibrated=scaled[1.06], old=near, scratch=scaled[1.04]).kept == "old"
    assert decided(recalibrated=scaled[1.06], old=near, scratch=scaled[0.9]).kept == "scratch"
    by_chance = [0.5, 1.5] * 10
    judged = decided(recalibrated=by_chance, old=[2.0] * 20, scratch=near)
    assert judged.kept == "recalibrated"
    assert judged.rms["scratch"] < judged.rms["recalibrated"]


def test_one_outlier_does_not_favour_a_worse_candidate():
    hopeless = [30.0] * 9 + [5_000.0]
    assert decided(recalibrated=hopeless, old=[31.0] * 10, scratch=[0.9, 1.1] * 5).kept == "scratch"


def test_a_much_better_candidate_is_kept_whatever_the_distribution():
    by_metres = [40.0, 1e-3, 0.3, 4.0, 6.0, 9.0]
    by_luck = [2e-3, 0.2, 3e-3, 0.5, 4e-4, 0.3]
    assert decided(recalibrated=by_metres, old=by_metres, scratch=by_luck).kept == "scratch"


def test_a_candidate_that_cannot_be_fitted_is_not_kept():
    judged = decided(recalibrated=[2.0, 2.1] * 5, old=[1.0, 1.1] * 5, scratch=[math.inf, 0.9] * 5)
    assert (judged.kept, judged.rms["scratch"]) == ("old", None)
    assert "scratch" not in judged.sentence


def test_a_row_that_every_candidate_misses_does_not_count():
    judged = decided(recalibrated=[1.0, 1.0, 1.0, 90.0], old=[1.2] * 3 + [80.0], scratch=[3.0] * 3 + [50.0])
    assert (judged.kept, judged.held_out_row_count) == ("recalibrated", 3)
    assert_close(judged.rms["recalibrated"], 1.0)


def test_without_held_out_rows_the_recalibrated_model_is_kept():
    judged = decided(recalibrated=[math.nan] * 2, old=[math.nan] * 2, scratch=[math.nan] * 2)
    assert (judged.kept, judged.held_out_row_count) == ("recalibrated", 0)
    assert not any(character.isdigit() for character in judged.sentence)  # no errors are known


@pytest.mark.parametrize("count", [5, 10])
def test_held_out_rows_decide(count):
    model, rows = original_model(), rows_after_change(count, 2, (0.0, 0.0, math.radians(0.25), 0.0, 0.0, 0.0))
    posterior = ModelPosterior.from_model(model)
    problem = recalibration_problem(model, posterior, rows, frozenset())
    whole = adapt(problem)
    calibrator = HybridCalibrator(posterior.space.robot)
    judged = choose_candidate(model, whole, frozenset(), rows, calibrator, lambda what: None)
    assert (judged.kept, judged.held_out_row_count) == ("recalibrated", count)
    kept, old = judged.rms["recalibrated"], judged.rms["old"]
    assert kept is not None
    assert old is not None
    assert MIN_RATIO * kept < old
