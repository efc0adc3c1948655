"""Drift sizes by evidence, compared with evidence and least squares of dense matrices."""

import math

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.estimation.drift import LOG_PRIOR_PENALTY, SIZES, Drift, DriftGroup, DriftSearch, LinearValues
from pisigma.estimation.regression import SensorValueCount

NOISE, MOVED = 1e-4, 4e-3


def search(moved: float, seed: int = 0, stated: bool = False) -> DriftSearch:
    """Fifty values of seven unknowns: three of a first group and one each of four others, one of which has moved."""
    rng = np.random.default_rng(seed)
    X = torch.from_numpy(rng.normal(size=(50, 7)))
    root = 1e-4 * torch.eye(7).double()[:, :5]
    u = root @ torch.from_numpy(rng.normal(size=5))
    u[4] += moved
    y = X @ u + NOISE * torch.from_numpy(rng.normal(size=50))
    groups = [DriftGroup("lengths", torch.arange(3), torch.ones(3).double())]
    groups += [DriftGroup(f"joint {k}", torch.tensor([2 + k]), torch.ones(1).double()) for k in (1, 2, 3, 4)]
    values = LinearValues(
        *(X, y, torch.zeros(50, dtype=torch.int64), torch.arange(50)),
        (SensorValueCount(50.0, stated, stated),),
    )
    noise = torch.tensor([NOISE]).double()
    return DriftSearch(values, X @ root, groups, noise, noise)


def estimated(looked_at: DriftSearch) -> Drift:
    looked_at.estimate_sizes()
    return looked_at.drift


def dense_evidence(looked_at: DriftSearch, sizes: list[float]) -> float:
    values = looked_at.values
    V = looked_at._K + NOISE**2 * torch.eye(50).double()
    for group, size in zip(looked_at._groups, sizes, strict=True):
        Z = values.X[:, group.index] * group.sigma_at_unit_size
        V = V + size**2 * Z @ Z.t()
    return -0.5 * float(values.y @ torch.linalg.solve(V, values.y) + torch.logdet(V))


def test_only_what_moved_has_a_size():
    drift = estimated(search(MOVED))
    sizes = {group.name: group.drift_size for group in drift.groups}
    assert [what for what, size in sizes.items() if size] == ["joint 2"]
    assert_close(math.log10(sizes["joint 2"]), math.log10(MOVED), atol=0.3)
    assert_close(drift.noise[0], NOISE, rtol=0.3)


@pytest.mark.parametrize("seed", range(8))
def test_nothing_has_a_size_if_nothing_moved(seed):
    assert not any(group.drift_size for group in estimated(search(0.0, seed)).groups)


def test_a_size_has_the_highest_evidence():
    looked_at = search(MOVED, stated=True)
    drift = estimated(looked_at)
    sizes = [group.drift_size for group in drift.groups]
    best = dense_evidence(looked_at, sizes)
    number = sizes.index(max(sizes))
    for size in (0.0, *SIZES[::5].tolist()):
        assert dense_evidence(looked_at, [*sizes[:number], size, *sizes[number + 1 :]]) <= best + 1e-9
    assert_close(drift.log_evidence, best - LOG_PRIOR_PENALTY, rtol=1e-9)


def test_a_shift_is_that_of_least_squares():
    looked_at = search(MOVED, stated=True)
    number = [group.drift_size > 0 for group in estimated(looked_at).groups].index(True)
    shift, covariance = looked_at.estimate_shift(number, with_prior=False)
    x = looked_at.values.X[:, 4]
    V = looked_at._K + NOISE**2 * torch.eye(50).double()
    weight = torch.linalg.solve(V, x)
    assert_close(covariance[0, 0], 1 / (x @ weight), rtol=1e-9)
    assert_close(shift[0], (weight @ looked_at.values.y) / (x @ weight), rtol=1e-9)
    held, narrower = looked_at.estimate_shift(number)
    assert abs(float(held)) < abs(float(shift))
    assert float(narrower) < float(covariance)


def test_larger_noise_is_detected():
    looked_at = search(0.0)
    looked_at.values.y.add_(3 * NOISE * torch.from_numpy(np.random.default_rng(5).normal(size=50)))
    assert float(estimated(looked_at).noise[0]) > 2 * NOISE
