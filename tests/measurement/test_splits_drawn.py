"""Draws of training rows: whole configurations, the same ones with the same seed, and their number."""

import pytest
import torch
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.splits import draw_rows, k_folds, with_fewer_training_rows


def repeats(configurations: int, each: int) -> Measurements:
    q = torch.arange(configurations, dtype=torch.float64).repeat_interleave(each)[:, None].repeat(1, 2)
    return Measurements(q=q, position=torch.zeros(len(q), 3, dtype=torch.float64), source="rows.csv")


@pytest.mark.parametrize("rows", [1, 7, 40])
def test_the_number_of_rows_is_met_without_groups(rows: int) -> None:
    drawn = draw_rows(repeats(40, 1), rows, 0)
    assert len(drawn) == rows
    assert drawn.tolist() == sorted(set(drawn.tolist()))


def test_configurations_stay_whole_and_the_number_is_met_as_closely_as_possible() -> None:
    data = repeats(12, 5)
    drawn = draw_rows(data, 23, 3)
    assert len(drawn) == 25
    assert torch.bincount(drawn // 5).tolist().count(5) == 5


def test_small_draws_are_subsets_of_large_ones_and_seeds_differ() -> None:
    data = repeats(60, 2)
    few, many, other = (
        set(draw_rows(data, rows, seed).tolist()) for rows, seed in ((20, 0), (50, 0), (20, 1))
    )
    assert few < many
    assert few != other


@pytest.mark.parametrize("rows", [0, 61])
def test_more_rows_than_there_are_are_refused(rows: int) -> None:
    with refused(MeasurementError, file="rows.csv", option="train_rows", value=rows):
        draw_rows(repeats(60, 1), rows, 0)


def test_the_held_out_rows_of_a_fold_are_kept() -> None:
    data = repeats(50, 1)
    folds = k_folds(data, 5, 0)
    fewer = with_fewer_training_rows(data, folds, 11, 0)
    for (train, test), (drawn, kept) in zip(folds, fewer, strict=True):
        assert torch.equal(test, kept)
        assert len(drawn) == 11
        assert set(drawn.tolist()) <= set(train.tolist())
    with refused(MeasurementError, option="train_rows", value=41):
        with_fewer_training_rows(data, folds, 41, 0)
