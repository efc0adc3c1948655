"""Bootstrap intervals: the figures of every resample, whole groups, and how often an interval holds the truth."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from testing.closeness import assert_close

from pisigma.errors import MeasurementError
from pisigma.judging import bootstrap as module
from pisigma.judging.bootstrap import Bootstrap

ROWS = 40


def grouped(seed: int, groups: int, models: int = 2) -> tuple[torch.Tensor, torch.Tensor]:
    """Errors of 40 rows in groups of different sizes, in any order."""
    rng = np.random.default_rng(seed)
    group = np.concatenate([np.arange(groups), rng.integers(0, groups, ROWS - groups)])
    errors = rng.gamma(2.0, 1e-4, (models, ROWS)) + 1e-4 * group
    return torch.from_numpy(errors), torch.from_numpy(rng.permutation(group))


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 100), st.integers(1, 12))
def test_every_resample_is_what_numpy_finds(seed: int, groups: int):
    errors, group = grouped(seed, groups)
    bootstrap = Bootstrap(resamples=20, seed=seed)
    found = bootstrap.statistics(errors, group)
    for resample, counts in enumerate(torch.cat(list(bootstrap._draws(groups, ROWS))).long()):
        assert int(counts.sum()) == groups
        rows = np.repeat(np.arange(ROWS), counts[group].numpy())
        for model in range(2):
            drawn = errors[model].numpy()[rows]
            assert_close(found["mean"][resample, model], drawn.mean(), rtol=1e-12)
            assert_close(found["rms"][resample, model], np.sqrt((drawn**2).mean()), rtol=1e-12)
            assert_close(found["p95"][resample, model], np.quantile(drawn, 0.95), rtol=1e-12)


def test_intervals_are_quantiles_of_the_resamples():
    errors, group = grouped(0, 8)
    bootstrap = Bootstrap(resamples=500, seed=3, confidence=0.9)
    values = bootstrap.statistics(errors, group)["rms"]
    assert_close(
        bootstrap.intervals(values, 8), np.quantile(values.numpy(), [0.05, 0.95], axis=0).T, rtol=1e-12
    )


def test_the_seed_decides_and_nothing_else(monkeypatch):
    errors, group = grouped(1, 9)
    state = torch.random.get_rng_state()
    first, again, other = (Bootstrap(50, seed).statistics(errors, group)["mean"] for seed in (5, 5, 6))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert_close(
        Bootstrap(50, 5).statistics(errors[:1], group)["mean"], first[:, :1]
    )  # whoever stands beside
    monkeypatch.setattr(module, "_DRAWN", 1)
    assert_close(Bootstrap(50, 5).statistics(errors, group)["mean"].shape, first.shape)


def test_repeats_of_a_configuration_make_no_interval_narrower():
    """Thirty copies of every row tell nothing new; drawn as rows they would narrow it by √30."""
    errors, group = torch.rand(1, 25, generator=torch.Generator().manual_seed(0)).double(), torch.arange(25)
    bootstrap = Bootstrap(400, seed=0)
    once = bootstrap.statistics(errors, group)
    often = bootstrap.statistics(errors.repeat_interleave(30, 1), group.repeat_interleave(30))
    for name in ("mean", "rms"):
        assert_close(often[name], once[name], rtol=1e-12)
    as_rows = bootstrap.statistics(errors.repeat_interleave(30, 1), torch.arange(750))
    assert float(as_rows["mean"].std()) < float(once["mean"].std()) / 4


def test_an_interval_holds_the_truth_as_often_as_it_says():
    """200 sets of 60 configurations with 2 rows each; 95 % of the intervals shall hold the true mean and RMS."""
    rng = np.random.default_rng(0)
    held = {"mean": 0, "rms": 0}
    truth = {"mean": 2.0, "rms": np.sqrt(6.0)}  # of a gamma distribution of shape 2
    group = torch.arange(60).repeat_interleave(2)
    for _ in range(200):
        errors = torch.from_numpy(rng.gamma(2.0, 1.0, (1, 60))).repeat_interleave(2, 1)
        bootstrap = Bootstrap(400, seed=1)
        found = bootstrap.statistics(errors, group)
        for name, value in truth.items():
            low, high = bootstrap.intervals(found[name], 60)[0].tolist()
            held[name] += low <= value <= high
    assert 176 <= held["mean"] <= 198
    assert 174 <= held["rms"] <= 198


def test_a_single_configuration_has_no_interval():
    bootstrap = Bootstrap(10)
    values = bootstrap.statistics(torch.ones(1, 5).double(), torch.zeros(5, dtype=torch.int64))
    assert_close(values["p95"], 1.0)
    assert bool(bootstrap.intervals(values["p95"], 1).isnan().all())


@pytest.mark.parametrize(("resamples", "confidence"), [(1, 0.95), (100, 0.0), (100, 1.0)])
def test_refuses_what_gives_no_interval(resamples: int, confidence: float):
    with pytest.raises(MeasurementError, match="2 resamples or more and a confidence between 0 and 1"):
        Bootstrap(resamples, confidence=confidence)
