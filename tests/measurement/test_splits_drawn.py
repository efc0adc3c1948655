"""Fewer rows: whole configurations, the same ones with the same seed, and honest numbers."""

import pytest
import torch

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import draw_rows, k_folds, with_fewer


def repeats(configurations: int, each: int) -> Measurements:
    q = torch.arange(configurations, dtype=torch.float64).repeat_interleave(each)[:, None].repeat(1, 2)
    return Measurements(q=q, position=torch.zeros(len(q), 3, dtype=torch.float64), source="rows.csv")


@pytest.mark.parametrize("rows", [1, 7, 40])
def test_as_many_as_wanted_where_no_rows_belong_together(rows: int) -> None:
    drawn = draw_rows(repeats(40, 1), rows, 0)
    assert len(drawn) == rows
    assert drawn.tolist() == sorted(set(drawn.tolist()))


def test_configurations_stay_whole_and_the_number_is_met_as_closely_as_may_be() -> None:
    data = repeats(12, 5)
    drawn = draw_rows(data, 23, 3)
    assert len(drawn) == 25
    assert torch.bincount(drawn // 5).tolist().count(5) == 5


def test_small_draws_are_part_of_large_ones_and_seeds_differ() -> None:
    data = repeats(60, 2)
    few, many, other = (
        set(draw_rows(data, rows, seed).tolist()) for rows, seed in ((20, 0), (50, 0), (20, 1))
    )
    assert few < many
    assert few != other


@pytest.mark.parametrize("rows", [0, 61])
def test_more_rows_than_there_are_is_refused(rows: int) -> None:
    with pytest.raises(MeasurementError, match=rf"rows\.csv: {rows} training rows .* ask for 1 to 60"):
        draw_rows(repeats(60, 1), rows, 0)


def test_the_test_rows_of_a_fold_stay() -> None:
    data = repeats(50, 1)
    folds = k_folds(data, 5, 0)
    fewer = with_fewer(data, folds, 11, 0)
    for (train, test), (drawn, kept) in zip(folds, fewer, strict=True):
        assert torch.equal(test, kept)
        assert len(drawn) == 11
        assert set(drawn.tolist()) <= set(train.tolist())
    with pytest.raises(MeasurementError, match="there are 40 to draw from"):
        with_fewer(data, folds, 41, 0)
