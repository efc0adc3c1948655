"""Configurations with wrong measurements, with a moved joint and many unknowns."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.estimation.drift import DriftGroup, DriftSearch, LinearValues
from pisigma.estimation.regression import SensorValueCount
from pisigma.estimation.wrong_rows import ExplainedRows, mark_wrong_rows

NOISE, MOVED, CONFIGURATIONS = 1e-4, 4e-3, 12


def explained(off: float, seed: int = 0) -> ExplainedRows[DriftSearch]:
    """Three values per configuration, one of them wrong, with as many unknowns as values and a moved joint."""
    rng, count = np.random.default_rng(seed), 3 * CONFIGURATIONS
    X = torch.from_numpy(rng.normal(size=(count, count + 1)))
    y = MOVED * X[:, 0] + NOISE * torch.from_numpy(rng.normal(size=count))
    y[15:18] += off * torch.tensor([0.6, 0.8, 0.0]).double()
    noise = torch.tensor([NOISE]).double()
    configuration = torch.arange(CONFIGURATIONS).repeat_interleave(3)
    counts = (SensorValueCount(float(count), has_stated_noise=False, has_exact_noise=False),)
    groups = [DriftGroup("joint 1", torch.tensor([0]), torch.ones(1).double())]
    groups += [DriftGroup("correction", torch.arange(1, count + 1), torch.ones(count).double())]

    values = LinearValues(X, y, torch.zeros(count, dtype=torch.int64), configuration, counts)

    def explain(wrong) -> ExplainedRows[DriftSearch]:
        there = replace(values, wrong_configurations=wrong)
        search = DriftSearch(there, 1e-6 * X, groups, noise, noise)
        search.estimate_sizes()
        return ExplainedRows(search, there, search.log_evidence, search.covariance, search.sigma)

    return mark_wrong_rows(explain({}), explain)


@pytest.mark.parametrize("off", [0.005, 0.5])
def test_a_wrong_configuration_is_found_despite_a_drift(off):
    result = explained(off)
    assert list(result.values.wrong_configurations) == [5]
    assert [group.name for group in result.explanation.drift.groups if group.drift_size] == ["joint 1"]
    assert_close(result.explanation.estimate_shift(0)[0], torch.tensor([MOVED]), rtol=0.05)
    expected = result.explanation.drift.noise * torch.ones(36).double()
    assert_close(result.sigma[:15], expected[:15])
    assert float(result.sigma[15]) > 10 * NOISE


@pytest.mark.parametrize("seed", range(5))
def test_no_configuration_is_wrong_if_all_are_correct(seed):
    assert not explained(0.0, seed).values.wrong_configurations
