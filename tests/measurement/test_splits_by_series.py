"""One series against another: no configuration that is tested was trained with."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pisigma.errors import MeasurementError
from pisigma.measurement import Measurements, join
from pisigma.measurement.splits import leave_one_series_out, one_against_another, series_of


def rows(labels: list[int], **more: object) -> Measurements:
    """A position per label; equal labels have equal joints."""
    label = torch.tensor(labels, dtype=torch.float64)
    position = torch.arange(3.0 * len(labels), dtype=torch.float64).view(-1, 3)
    return Measurements(q=torch.stack([label, -label], 1), position=position, **more)  # type: ignore[arg-type]


def test_one_series_against_another():
    data, names = rows(list(range(6))), ("a", "b", "", "a", "c", "b")
    train, test = one_against_another(data, names, test="b", train="a")
    assert (train.tolist(), test.tolist()) == ([0, 3], [1, 5])
    train, test = one_against_another(data, names, test="b")
    assert (train.tolist(), test.tolist()) == ([0, 3, 4], [1, 5])


def test_every_series_once():
    parts = leave_one_series_out(rows(list(range(5))), ("x", "y", "x", "z", "z"))
    assert [test.tolist() for _, test in parts] == [[0, 2], [1], [3, 4]]


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 12), st.sampled_from("abc")), min_size=2, max_size=40))
def test_no_configuration_is_in_both_parts(given_rows: list[tuple[int, str]]):
    labels, names = ([row[0] for row in given_rows], [row[1] for row in given_rows])
    wanted = names[0]
    tested = {label for label, name in given_rows if name == wanted}
    if all(label in tested for label in labels):
        with pytest.raises(MeasurementError, match="no row is left to train on"):
            one_against_another(rows(labels), names, wanted)
        return
    train, test = one_against_another(rows(labels), names, wanted)
    assert test.tolist() == [row for row, name in enumerate(names) if name == wanted]
    assert not {labels[row] for row in train} & {labels[row] for row in test}
    assert wanted not in {names[row] for row in train}


def test_series_of_columns():
    data = rows(
        [0, 1, 2],
        frame=("wall", "floor", "wall"),
        split=("train", "test", "test"),
        payload=torch.tensor([0.0, 2.5, torch.nan], dtype=torch.float64),
    )
    assert series_of(data, "frame") == ("wall", "floor", "wall")
    assert series_of(data, "set") == ("train", "test", "test")
    assert series_of(data, "payload_kg") == ("0", "2.5", "")
    for column in ("target", "temperature_c"):
        with pytest.raises(MeasurementError, match=f"no row has a value in the column '{column}'"):
            series_of(data, column)


def test_series_of_two_files():
    monday, friday = rows([0, 1, 2]), rows([3, 4])
    names = ("monday",) * monday.rows + ("friday",) * friday.rows
    train, test = one_against_another(join([monday, friday]), names, test="friday")
    assert (train.tolist(), test.tolist()) == ([0, 1, 2], [3, 4])


def test_refusals():
    data = rows([0, 1, 2])
    with pytest.raises(MeasurementError, match="no series 'mondy'; did you mean 'monday'"):
        one_against_another(data, ("monday", "friday", "friday"), "mondy")
    with pytest.raises(MeasurementError, match="cannot be tested on itself"):
        one_against_another(data, ("a", "b", "b"), "a", "a")
    with pytest.raises(MeasurementError, match="a series for each of 3 rows was wanted, got 2"):
        one_against_another(data, ("a", "b"), "a")
    with pytest.raises(MeasurementError, match="two series or more were wanted, got 1"):
        leave_one_series_out(data, ("a", "", "a"))
