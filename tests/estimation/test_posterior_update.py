"""The posterior after new values, compared with Kalman's formulas with dense matrices."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.estimation.drift import MAX_DIRECTIONS, Drift, DriftGroup, LinearValues, PosteriorUpdate
from pisigma.estimation.regression import SensorValueCount

UNKNOWNS, DIRECTIONS, NOISE = 30, 32, 0.3


@pytest.mark.parametrize("count", [5, 80])
@pytest.mark.parametrize("drifted", [1, UNKNOWNS])
def test_the_posterior_is_that_of_kalman(count, drifted):
    rng = np.random.default_rng(count)
    root, X, y = (torch.from_numpy(rng.normal(size=n)) for n in ((30, 32), (count, 30), (count,)))
    root[4] = 0.0  # a parameter that was not free
    group = DriftGroup("lengths", torch.arange(drifted), torch.full((drifted,), 0.5).double(), 2.0)
    sensor, counts = torch.zeros(count, dtype=torch.int64), (SensorValueCount(float(count), False, False),)
    values = LinearValues(X, y, sensor, torch.arange(count), counts)
    update = PosteriorUpdate(root, values, Drift((group,), torch.tensor([NOISE]).double()))
    C = root @ root.t()
    C[range(drifted), range(drifted)] += 1.0
    gain = torch.linalg.solve(X @ C @ X.t() + NOISE**2 * torch.eye(count).double(), X @ C).t()
    assert_close(update.shift, gain @ y, atol=1e-9)
    after = update.covariance_root()
    assert after.shape[1] <= MAX_DIRECTIONS * UNKNOWNS or drifted == 1
    assert_close(after @ after.t(), C - gain @ X @ C, atol=1e-9)
    assert_close(after[4].norm() > 0, drifted > 4)
    assert_close(update.effective_unknowns, torch.trace(X @ gain), rtol=1e-9)
