"""Bootstrap intervals: whole configurations are drawn, and an interval holds the truth as often as it says."""

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.validation.held_out import model_comparison as module
from pisigma.validation.held_out.model_comparison import STATISTICS, confidence_intervals, statistics
from pisigma.validation.resampling import Bootstrap

ROWS = 40


def grouped(seed: int, groups: int, models: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Errors of 40 rows in groups of different sizes, in any order."""
    rng = np.random.default_rng(seed)
    group = np.concatenate([np.arange(groups), rng.integers(0, groups, ROWS - groups)])
    errors = rng.gamma(2.0, 1e-4, (models, ROWS)) + 1e-4 * group
    return errors, rng.permutation(group)


def by_numpy(errors: np.ndarray) -> np.ndarray:
    """Mean, RMS and 95 % quantile of every model's errors."""
    mean, rms = errors.mean(1), np.sqrt((errors**2).mean(1))
    values = {"mean": mean, "rms": rms, "p95": np.quantile(errors, 0.95, axis=1)}
    return np.stack([values[name] for name in STATISTICS])


def test_statistics_of_repeated_errors_are_numpys():
    errors, _ = grouped(0, 8)
    for times in (np.ones(ROWS, dtype=np.int64), np.arange(ROWS)[::-1] % 4):
        for of_model in errors:
            expected = by_numpy(np.repeat(of_model, times)[None])[:, 0]
            assert_close(statistics(of_model, times), expected, rtol=1e-12)
            assert_close(statistics(of_model, np.stack([times, times]))[:, 1], expected, rtol=1e-12)


@pytest.mark.parametrize("groups", [2, 9, ROWS])
def test_intervals_are_those_of_resamples_drawn_by_hand(groups: int):
    """Whole groups, as many as there are, with replacement; models and differences on the same resamples."""
    errors, group = grouped(3, groups)
    rng, resamples = np.random.default_rng(5), []
    for drawn in rng.integers(0, groups, (800, groups)):
        rows = np.concatenate([np.flatnonzero(group == index) for index in drawn])
        resamples.append(by_numpy(errors[:, rows]))
    values = np.stack(resamples, -1)
    found = confidence_intervals(Bootstrap(resamples=800, seed=5, confidence=0.9), errors, group)
    spread = values.std(-1).max()
    for intervals, own in ((found.value, values), (found.difference, values - values[:, :1])):
        expected = np.moveaxis(np.quantile(own, [0.05, 0.95], axis=-1), 0, -1)
        assert_close(intervals, expected, atol=0.4 * spread)
    assert_close(found.difference[:, 0], 0.0)


def test_only_the_seed_determines_the_result(monkeypatch):
    errors, group = grouped(1, 9)
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    first, again, other = (
        confidence_intervals(Bootstrap(50, seed), errors, group).value for seed in (5, 5, 6)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
    assert np.array_equal(np.random.get_state()[1], state)  # noqa: NPY002
    alone = confidence_intervals(Bootstrap(50, 5), errors[:1], group).value
    assert_close(alone, first[:, :1], rtol=1e-12)  # whatever stands beside it
    monkeypatch.setattr(module, "_BATCH", 1)
    assert_close(confidence_intervals(Bootstrap(50, 5), errors, group).value, first, rtol=1e-12)


def test_repeats_of_a_configuration_make_no_interval_narrower():
    """Thirty copies of every row say nothing new; drawn as rows they would narrow it by √30."""
    errors, group = np.random.default_rng(0).uniform(size=(1, 25)), np.arange(25)
    bootstrap = Bootstrap(400, seed=0)
    once = confidence_intervals(bootstrap, errors, group).value
    often = confidence_intervals(bootstrap, errors.repeat(30, 1), group.repeat(30)).value
    assert_close(often[:2], once[:2], rtol=1e-12)
    as_rows = confidence_intervals(bootstrap, errors.repeat(30, 1), np.arange(750)).value
    assert np.diff(as_rows[0, 0]) < np.diff(once[0, 0]) / 4


def test_an_interval_covers_the_true_value_as_often_as_stated():
    """60 sets of 60 configurations with 2 rows each; 95 % of the intervals shall hold the true mean and RMS."""
    rng = np.random.default_rng(0)
    truth = np.array([2.0, np.sqrt(6.0)])  # of a gamma distribution of shape 2
    held = np.zeros(2)
    for _ in range(60):
        errors = rng.gamma(2.0, 1.0, (1, 60)).repeat(2, 1)
        low, high = (
            confidence_intervals(Bootstrap(150, seed=1), errors, np.arange(60).repeat(2)).value[:2, 0].T
        )
        held += (low <= truth) & (truth <= high)
    assert np.all((held >= 51) & (held <= 60))


def test_a_single_configuration_has_no_interval():
    found = confidence_intervals(Bootstrap(10), np.ones((1, 5)), np.zeros(5, dtype=np.int64))
    assert np.isnan(found.value).all()
    assert np.isnan(found.difference).all()


@pytest.mark.parametrize(
    ("option", "value"),
    [("resamples", 1), ("resamples", 10**10), ("confidence", 0.0), ("confidence", 1.0), ("seed", -1)],
)
def test_refuses_settings_that_give_no_interval(option: str, value: float):
    with refused(MeasurementError, option=option, value=value):
        Bootstrap(**{option: value})
