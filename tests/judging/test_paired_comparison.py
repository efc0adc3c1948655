"""Paired comparisons of two models, and Wilcoxon's test against scipy and by hand."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import wilcoxon
from testing.closeness import assert_close

from pisigma.judging.bootstrap import Bootstrap
from pisigma.judging.paired_comparison import PairedComparison
from pisigma.judging.signed_rank import signed_rank


def tensor(values: list) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def test_signed_rank_by_hand():
    # sizes 1, 2, 2, 3, 4 have the ranks 1, 2.5, 2.5, 4, 5; the zero is left out
    found = signed_rank(tensor([1.0, -2.0, 2.0, 0.0, 3.0, 4.0]))
    assert (found.pairs, found.statistic) == (5, 2.5)
    variance = 5 * 6 * 11 / 24 - (2**3 - 2) / 48
    assert_close(found.z, (2.5 - 7.5) / math.sqrt(variance), atol=1e-15)
    assert_close(found.p, math.erfc(5 / math.sqrt(2 * variance)), atol=1e-15)


@settings(deadline=None)
@given(st.lists(st.integers(-8, 8), min_size=2, max_size=60))
def test_signed_rank_agrees_with_scipy(values: list[int]):
    if not any(values):
        return
    found = signed_rank(tensor(values))
    peer = wilcoxon(values, zero_method="wilcox", correction=False, method="asymptotic")
    assert_close(found.statistic, peer.statistic, atol=1e-12)
    assert_close(found.p, peer.pvalue, atol=1e-12)
    assert_close(found.z, peer.zstatistic if peer.zstatistic <= 0 else -peer.zstatistic, atol=1e-12)
    assert signed_rank(-tensor(values)) == found


def test_no_difference_is_no_difference():
    found = signed_rank(torch.zeros(4, dtype=torch.float64))
    assert (found.statistic, found.z, found.p, found.pairs) == (0.0, 0.0, 1.0, 0)


def errors(seed: int = 0, rows: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    worse = rng.gamma(3.0, 1e-4, rows)
    return torch.from_numpy(0.6 * worse + rng.normal(0, 2e-5, rows).clip(-5e-5)), torch.from_numpy(worse)


def test_differences_are_those_of_the_statistics():
    better, worse = (e.abs() for e in errors())
    group = torch.arange(50) // 2
    found = PairedComparison.of(better, worse, group, Bootstrap(300, seed=2))
    a, b = better.numpy(), worse.numpy()
    assert_close(found.difference["mean"], a.mean() - b.mean(), rtol=1e-12)
    assert_close(found.difference["rms"], np.sqrt((a**2).mean()) - np.sqrt((b**2).mean()), rtol=1e-12)
    assert_close(found.difference["p95"], np.quantile(a, 0.95) - np.quantile(b, 0.95), rtol=1e-12)
    means = (a - b).reshape(25, 2).mean(1)
    peer = wilcoxon(means, correction=False, method="asymptotic")
    assert_close(found.test.p, peer.pvalue, atol=1e-12)
    assert_close(found.better, (means < 0).mean())
    for name, value in found.difference.items():
        low, high = found.interval[name]
        assert low < value < high < 0


def test_the_rows_are_paired():
    """A tenth of a percent less on every row is seen, however much rows differ."""
    _, worse = errors(rows=200)
    found = PairedComparison.of(0.999 * worse, worse, torch.arange(200), Bootstrap(300))
    assert found.interval["mean"][1] < 0
    assert found.better == 1.0
    assert found.test.p < 1e-10
    same = PairedComparison.of(worse, worse, torch.arange(200), Bootstrap(300))
    assert same.interval["rms"] == (0.0, 0.0)
    assert (same.better, same.test.p) == (0.0, 1.0)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("deg", 180 / math.pi)])
def test_in_file_units(unit: str, factor: float):
    better, worse = errors()
    found = PairedComparison.of(better, worse, torch.arange(50), Bootstrap(100))
    figures = found.in_file_units(unit)
    assert_close(figures[f"rms_{unit}"], factor * found.difference["rms"], rtol=1e-14)
    assert_close(figures[f"rms_{unit}_interval"], factor * np.array(found.interval["rms"]), rtol=1e-14)
    alone = PairedComparison.of(better, worse, torch.zeros(50, dtype=torch.int64), Bootstrap(100))
    assert alone.in_file_units(unit)[f"mean_{unit}_interval"] is None
