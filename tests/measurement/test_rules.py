"""Data sets in memory with touches, sockets and distances; groups, folds and concatenation."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements, join
from pisigma.measurement.groups import groups_to_keep_whole
from pisigma.measurement.splits import holdout, k_folds

NAN = float("nan")


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def make() -> Measurements:
    """A socket row, a touch, a distance from a known anchor, and a pair."""
    return Measurements(
        q=torch.arange(5, dtype=torch.float64)[:, None].repeat(1, 2),
        frame=("", "left", "", "", ""),
        socket=("s", "", "", "", ""),
        touch_axis=("", "y", "", "", ""),
        touch=column(NAN, -0.1, NAN, NAN, NAN),
        distance=column(NAN, NAN, 1.0, 0.5, 0.5),
        anchor=("", "", "w", "", ""),
        anchor_place=torch.tensor([[NAN] * 3] * 2 + [[1.0, 2.0, 3.0]] + [[NAN] * 3] * 2, dtype=torch.float64),
        pair=("", "", "", "p", "p"),
    )


def test_kinds_of_measurements():
    data = make()
    assert data.kinds == {"socket", "touch", "distance"}
    assert data.select(torch.tensor([0])).kinds == {"socket"}
    assert data.select(torch.tensor([], dtype=torch.int64)).kinds == set()
    rotation = torch.eye(3, dtype=torch.float64).repeat(5, 1, 1)
    assert replace(data, rotation=rotation).kinds == {"socket", "touch", "distance", "rotation"}
    assert data.select(torch.tensor([1, 2])).socket is None


@pytest.mark.parametrize(
    ("change", "row", "column", "value"),
    [
        ({"touch_axis": ("", "u", "", "", "")}, 1, "touch_axis", "u"),
        ({"touch_axis": None}, 1, "touch_axis", ""),
        ({"touch": None}, 1, "touch", None),
        ({"frame": ("",) * 5}, 1, "frame", ""),
        ({"distance": column(NAN, NAN, -1.0, 0.5, 0.5)}, 2, "distance", -1.0),
        ({"distance": column(NAN, NAN, NAN, 0.5, 0.5)}, 2, "distance", None),
        ({"anchor": None, "anchor_place": None}, 2, "anchor", None),
        ({"anchor": None}, 2, "anchor", None),
        ({"pair": ("", "", "p", "p", "p")}, 2, "anchor", None),
        ({"pair": ("", "", "", "p", "r")}, 3, "pair", "1 row"),
        ({"distance": column(NAN, NAN, 1.0, 0.5, 0.6)}, 3, "pair", "0.5 and 0.6"),
        ({"frame": ("", "left", "", "", "b")}, 3, "pair", "'' and 'b'"),
        ({"socket": ("s", "s", "", "", "")}, 1, "socket", "socket and touch"),
        ({"distance": column(NAN, NAN, float("inf"), 0.5, 0.5)}, 2, "distance", float("inf")),
        ({"anchor_place": torch.tensor([[NAN, 1.0, NAN]] * 5).double()}, 0, "anchor_place", "1 of them"),
    ],
)
def test_refuses_contradictory_rows(change: dict[str, object], row: int, column: str, value: object):
    with refused(MeasurementError, file="memory", column=column, value=value) as caught:
        replace(make(), **change)
    assert f"row {row}," in str(caught.value)


@pytest.mark.parametrize(
    ("change", "option", "value"),
    [({"socket": ("s",)}, "socket", 1), ({"touch": column(1.0)}, "touch", (1,))],
)
@pytest.mark.usefixtures("without_type_checker")
def test_refuses_fields_of_other_sizes(change: dict[str, object], option: str, value: object):
    with refused(MeasurementError, option=option, value=value):
        replace(make(), **change)


def test_a_pair_is_not_split():
    with refused(MeasurementError, column="pair", value="1 row"):
        make().select(torch.tensor([0, 3]))
    chosen = make().select(torch.tensor([4, 2, 3]))
    assert (chosen.pair, chosen.anchor) == (("p", "", "p"), ("", "w", ""))
    assert_close(chosen.distance, [0.5, 1.0, 0.5])
    assert_close(chosen.anchor_place[1], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    "change",
    [
        {"socket": ("t", "", "", "", "")},
        {"touch_axis": ("", "x", "", "", "")},
        {"touch": column(NAN, -0.1 - 1e-16, NAN, NAN, NAN)},
        {"anchor": ("", "", "v", "", "")},
        {"anchor_place": None},
        {"pair": ("", "", "", "r", "r")},
        {"distance": column(NAN, NAN, 1.0 + 1e-15, 0.5, 0.5)},
    ],
)
def test_the_hash_depends_on_every_field(change: dict[str, object]):
    assert replace(make(), **change).content_hash() != make().content_hash()
    assert make().content_hash() == replace(make(), source="elsewhere").content_hash()


def paired(count: int) -> Measurements:
    """Pairs whose first row is far from their second; rows 0 and 3 have equal joints."""
    q = torch.arange(2.0 * count, dtype=torch.float64)[:, None]
    q[3] = q[0]
    names = [f"p{row % count}" for row in range(2 * count)]
    return Measurements(q=q, distance=torch.ones(2 * count, dtype=torch.float64), pair=tuple(names))


def test_pairs_and_equal_joints_are_one_group():
    group = groups_to_keep_whole(paired(4)).tolist()
    assert group == [0, 1, 2, 0, 0, 1, 2, 0]
    assert groups_to_keep_whole(make()).tolist() == [0, 1, 2, 3, 3]
    empty = Measurements(q=torch.zeros(0, 2, dtype=torch.float64))
    assert groups_to_keep_whole(empty).tolist() == []


@pytest.mark.parametrize("by", ["joints", "time"])
def test_folds_never_split_a_pair(by: str):
    data = paired(9)
    for train, test in (*k_folds(data, 3, seed=1, by=by), holdout(data, 0.3, seed=1, by=by)):
        assert sorted([*train.tolist(), *test.tolist()]) == list(range(18))
        assert {data.pair[row] for row in train} & {data.pair[row] for row in test} == set()
        assert data.select(test).rows == len(test) > 0


def test_concatenation_fills_missing_fields():
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(2, 3, generator=generator, dtype=torch.float64)
    tracker = Measurements(
        q=position[:, :2], position=position, frame=("t", "t"), sigma_position=column(1.0, 2.0), source="a"
    )
    data = join([make(), tracker])
    assert data.rows == 7
    assert data.kinds == {"socket", "touch", "distance", "position"}
    assert data.source == "memory + a"
    assert data.frame[4:] == ("", "t", "t")
    assert data.select(torch.arange(5)).socket == make().socket
    assert_close(data.position[5:], position)
    assert data.position[:5].isnan().all()
    assert data.sigma_position[:5].isnan().all()
    assert join([tracker]).content_hash() == tracker.content_hash()


def test_refuses_data_sets_that_do_not_fit():
    one = Measurements(q=torch.zeros(1, 3, dtype=torch.float64))
    with refused(MeasurementError, option="data", value="none"):
        join([])
    with refused(MeasurementError, option="data", value="2 and 3"):
        join([make(), one])
    with refused(MeasurementError, option="data", value="split"):
        join([one, replace(one, split=("train",))])
    with refused(MeasurementError, column="pair", value="4 rows"):
        join([make(), make()])
