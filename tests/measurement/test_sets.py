"""The column `set`: rows marked as test are held out."""

import pytest
import torch
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements

Q = torch.arange(12, dtype=torch.float64).reshape(6, 2)


def rows(*split: str) -> Measurements:
    return Measurements(q=Q, split=split or None, source="rows.csv")


def test_rows_are_split_by_the_column():
    train, test = rows("train", "test", "train", "train", "test", "train").split_sets()
    assert train.q[:, 0].tolist() == [0, 4, 6, 10]
    assert test.q[:, 0].tolist() == [2, 8]
    assert set(train.split) == {"train"}
    assert set(test.split) == {"test"}


@pytest.mark.parametrize("split", [(), ("train",) * 6])
def test_without_test_rows_all_are_trained_on(split):
    measurements = rows(*split)
    assert measurements.split_sets() == (measurements, None)


def test_only_test_rows_are_refused():
    with refused(MeasurementError, file="rows.csv", column="set", value="test"):
        rows(*["test"] * 6).split_sets()
