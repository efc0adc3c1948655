"""Control charts: limits from the literature, steps, drifts, and correlated sessions."""

import math

import torch
from testing.closeness import assert_close

from pisigma.lifetime.monitoring.charts import (
    FALSE_ALARMS_PER_YEAR,
    SESSIONS_PER_YEAR,
    Chart,
    innovations,
    limits_of,
    mean_sessions_to_cusum_alarm,
    mean_sessions_to_ewma_alarm,
)


def chart(scores, one_sided=False):
    scores = torch.as_tensor(scores, dtype=torch.float64)
    return Chart(
        "joint 2", "deg", scores, torch.ones_like(scores), scores, limits_of(7, one_sided), one_sided
    )


def test_mean_run_lengths_are_those_of_the_literature():
    # Lucas and Saccucci 1990, table 3: weight 0.2, limit 3; Montgomery, Statistical Quality Control: k 0.5, h 5
    assert_close(mean_sessions_to_ewma_alarm(3 * math.sqrt(0.2 / 1.8), False), 559.9, rtol=0.01)
    assert_close(mean_sessions_to_cusum_alarm(5.0), 938.2, rtol=0.01)


def test_the_rate_of_false_alarms_is_as_stated():
    scores = torch.randn(60_000, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    limits, runs = limits_of(7), []
    average = rise = fall = 0.0
    for score in scores.tolist():
        average = 0.8 * average + 0.2 * score
        rise, fall = max(rise + score - 0.5, 0.0), max(fall - score - 0.5, 0.0)
        if abs(average) > limits.ewma or max(rise, fall) > limits.cusum:
            runs.append(score)
            average = rise = fall = 0.0
    per_year = 7 * SESSIONS_PER_YEAR * len(runs) / len(scores)
    assert per_year < 1.2 * FALSE_ALARMS_PER_YEAR


def test_a_step_is_found_and_an_outlier_is_not():
    assert chart([0.3, -0.5, 0.1, 0.4]).alarm is None
    stepped = chart([0.3, -0.5, 0.1, 3.0, 3.1, 2.9, 3.2])
    assert stepped.alarm in (4, 5)
    assert set(stepped.kinds) == {"EWMA", "CUSUM"}
    assert chart([-3.0] * 6).alarm is not None
    assert chart([-3.0] * 6, one_sided=True).alarm is None


def test_sessions_without_the_quantity_change_nothing():
    with_gap, without = chart([1.0, math.nan, 2.0]), chart([1.0, 2.0])
    assert_close(with_gap.ewma[[0, 2]], without.ewma, rtol=1e-12)
    assert_close(with_gap.cusum[[0, 2]], without.cusum, rtol=1e-12)


def test_a_common_error_is_not_a_drift():
    # the same error of the model in all sessions, far larger than their own noise
    covariance = 4.0 * torch.ones(20, 20, dtype=torch.float64) + 0.01 * torch.eye(20, dtype=torch.float64)
    drawn = torch.randn(20, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    scores = innovations(1.9 + 0.1 * drawn, covariance)
    assert float(scores.abs().max()) < 3.5
    assert chart(scores).alarm is None
    assert_close(torch.linalg.cholesky(covariance) @ scores, 1.9 + 0.1 * drawn, rtol=1e-12)


def test_values_that_are_missing_have_no_score():
    scores = innovations(torch.tensor([1.0, math.nan, 2.0]).double(), torch.eye(3).double())
    assert bool(scores[1].isnan())
    assert_close(scores[[0, 2]], torch.tensor([1.0, 2.0]).double(), rtol=1e-12)
