"""Folds partition the rows, keep equal joints together, and are as equal as possible."""

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from testing.refusals import refused

from pisigma.files.errors import MeasurementError
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, placements
from pisigma.measurement.splits import SplitBy, holdout, k_folds, repeated_k_folds

WAYS = ("joints", "interleaved", "time", "space")


def repeated(labels: list[int]) -> Measurements:
    """Return a measurement per label, with equal joints for equal labels and positions along x by label."""
    label = torch.tensor(labels, dtype=torch.float64)
    noise = torch.linspace(0, 1e-3, len(labels), dtype=torch.float64)
    position = torch.stack([label, noise, -noise], 1)
    return Measurements(q=torch.stack([label, -label], 1), position=position)


def test_groups_are_numbered_as_they_appear():
    q = torch.tensor([[2.0, 1], [0.0, 1], [2, 1], [-0.0, 1], [2, 1.002]], dtype=torch.float64)
    assert groups_of_equal_joints(q).tolist() == [0, 1, 0, 1, 2]
    assert groups_of_equal_joints(q[:0]).tolist() == []


def test_groups_of_a_measured_robot(shared_data: Path):
    measurements = Measurements.read_csv(shared_data / "fanuc_r2000" / "positions.csv")
    group = groups_of_equal_joints(measurements.q)
    assert torch.bincount(group).tolist() == [30] * 24
    for train, test in k_folds(measurements, 6, seed=0):
        assert (len(train), len(test)) == (600, 120)
        assert not set(group[train].tolist()) & set(group[test].tolist())


@settings(deadline=None, max_examples=150)
@given(
    st.lists(st.integers(0, 9), min_size=2, max_size=60),
    st.integers(2, 5),
    st.integers(0, 3),
    st.sampled_from(WAYS),
)
def test_folds_partition_the_rows_and_keep_groups_whole(labels: list[int], folds: int, seed: int, by: str):
    measurements = repeated(labels)
    folds = min(folds, len(set(labels)))
    if folds < 2:
        return
    parts = k_folds(measurements, folds, seed, by=by)
    assert len(parts) == folds
    assert sorted(row for _, test in parts for row in test.tolist()) == list(range(len(labels)))
    largest = max(labels.count(label) for label in labels)
    for train, test in parts:
        assert sorted(train.tolist() + test.tolist()) == list(range(len(labels)))
        assert test.tolist() == sorted(test.tolist())
        assert len(test) > 0
        assert not {labels[row] for row in train} & {labels[row] for row in test}
    if by == "joints":
        sizes = [len(test) for _, test in parts]
        assert max(sizes) - min(sizes) <= largest


@settings(deadline=None, max_examples=100)
@given(st.lists(st.integers(0, 9), min_size=2, max_size=60), st.floats(0.01, 0.99), st.sampled_from(WAYS))
def test_holdout_keeps_groups_whole_and_meets_the_share(labels: list[int], share: float, by: str):
    if len(set(labels)) < 2:
        return
    train, test = holdout(repeated(labels), share, seed=0, by=by)
    assert sorted(train.tolist() + test.tolist()) == list(range(len(labels)))
    assert min(len(train), len(test)) > 0
    assert not {labels[row] for row in train} & {labels[row] for row in test}
    largest = max(labels.count(label) for label in labels)
    assert abs(len(test) - share * len(labels)) <= largest


def test_the_result_depends_on_the_seed_only():
    measurements = repeated(list(range(40)))

    def tests(seed: int | torch.Generator) -> list[list[int]]:
        return [test.tolist() for _, test in k_folds(measurements, 4, seed)]

    state = torch.random.get_rng_state()
    assert tests(1) == tests(1) == tests(torch.Generator().manual_seed(1))
    assert tests(1) != tests(2)
    assert torch.equal(torch.random.get_rng_state(), state)


@pytest.mark.parametrize("seed", range(5))
def test_large_groups_are_balanced_by_many_small_ones(seed: int):
    parts = k_folds(repeated([0] * 6 + [1] * 4 + [2] * 3 + list(range(3, 8))), 3, seed)
    assert [len(test) for _, test in parts] == [6, 6, 6]


def test_interleaved_folds_alternate():
    measurements = repeated([7, 7, 3, 3, 5, 5, 1, 1, 4, 4, 0, 0, 2, 2])
    folds = k_folds(measurements, 3, seed=5, by="interleaved")
    assert [test.tolist() for _, test in folds] == [[0, 1, 6, 7, 12, 13], [2, 3, 8, 9], [4, 5, 10, 11]]
    _, test = holdout(measurements, 1 / 3, seed=5, by="interleaved")
    assert test.tolist() == [2, 3, 8, 9]
    for share in (0.01, 0.99):
        train, test = holdout(measurements, share, seed=5, by="interleaved")
        assert len(train) > 0
        assert len(test) > 0


def test_folds_by_time_are_blocks_of_the_file():
    parts = k_folds(repeated([5, 5, 3, 3, 9, 9, 1, 5]), 3, seed=0, by="time")
    assert [test.tolist() for _, test in parts] == [[0, 1, 7], [2, 3], [4, 5, 6]]
    train, test = holdout(repeated([5, 5, 3, 3, 9, 9, 1, 1]), 0.25, seed=0, by="time")
    assert (train.tolist(), test.tolist()) == ([0, 1, 2, 3, 4, 5], [6, 7])


def test_folds_by_space_are_boxes_that_do_not_overlap():
    generator = torch.Generator().manual_seed(0)
    position = (
        torch.rand(200, 3, generator=generator, dtype=torch.float64) * torch.tensor([4.0, 2.0, 0.5]).double()
    )
    measurements = Measurements(
        q=torch.rand(200, 6, generator=generator, dtype=torch.float64), position=position
    )
    boxes = [
        (position[test].amin(0), position[test].amax(0))
        for _, test in k_folds(measurements, 5, 0, by="space")
    ]
    for i, (low, high) in enumerate(boxes):
        for other_low, other_high in boxes[:i]:
            assert bool(((high < other_low) | (other_high < low)).any())
    assert {len(test) for _, test in k_folds(measurements, 5, 0, by="space")} == {40}
    train, test = holdout(measurements, 0.2, 0, by="space")
    assert len(test) == 40
    assert position[test, 0].min() > position[train, 0].max()


@pytest.mark.parametrize("folds", [-1, 0, 1, 4])
def test_refuses_more_folds_than_joint_vectors(folds: int):
    with refused(MeasurementError, option="folds", value=folds):
        k_folds(repeated([1, 1, 2, 3]), folds, seed=0)


def test_refuses_to_split_a_single_pose():
    with refused(MeasurementError, option="by", value="joints"):
        k_folds(repeated([1, 1, 1]), 2, seed=0)
    with refused(MeasurementError, option="by", value="joints"):
        holdout(repeated([1, 1, 1]), 0.5, seed=0)


@pytest.mark.parametrize("share", [0.0, 1.0, -0.5, float("nan")])
def test_refuses_a_share_that_is_not_between_0_and_1(share: float):
    with refused(MeasurementError, option="hold_out"):
        holdout(repeated([1, 2, 3]), share, seed=0)


def test_refuses_space_without_positions_to_compare():
    q = torch.arange(4.0).double()[:, None]
    position = torch.ones(4, 3, dtype=torch.float64)
    with refused(MeasurementError, option="by", file="memory") as caught:
        k_folds(Measurements(q=q), 2, 0, by="space")
    assert "row 0" in str(caught.value)
    position[2] = torch.nan
    with refused(MeasurementError, option="by", file="memory") as caught:
        holdout(Measurements(q=q, position=position), 0.5, 0, by="space")
    assert "row 2" in str(caught.value)
    with refused(MeasurementError, option="by", value="2 frames"):
        k_folds(Measurements(q=q, position=position, frame=("a", "a", "b", "b")), 2, 0, by="space")


def in_sockets(names: list[str], **more: object) -> Measurements:
    """Return a row per name of a socket, each with different joints."""
    q = torch.arange(2.0 * len(names), dtype=torch.float64).view(-1, 2)
    return Measurements(q=q, socket=tuple(names), **more)  # type: ignore[arg-type]


def test_placements_are_named_before_the_last_slash():
    data = in_sockets(["a/b/0", "a/b/1", "a/c/0", "lone", "lone"], frame=("one", "two", "one", "two", "two"))
    assert placements(data) == ("a/b", "a/b", "a/c", "lone", "lone")
    touches = Measurements(
        q=torch.arange(6, dtype=torch.float64).view(3, 2),
        frame=("left", "right", "left"),
        touch_axis=("x", "x", "y"),
        touch=torch.zeros(3, dtype=torch.float64),
    )
    assert placements(touches) == ("left", "right", "left")


def test_folds_by_placement_contain_one_placement():
    names = ["low/0", "low/1", "high/0", "low/0", "high/1", "far/0", "far/0"]
    parts = k_folds(in_sockets(names), None, seed=0, by="placement")
    tests = sorted(test.tolist() for _, test in parts)
    assert tests == [[0, 1, 3], [2, 4], [5, 6]]
    assert all(sorted(train.tolist() + test.tolist()) == list(range(7)) for train, test in parts)
    two = k_folds(in_sockets(names), 2, seed=0, by="placement")
    assert sorted(len(test) for _, test in two) == [3, 4]
    _, test = holdout(in_sockets(names), 0.3, seed=1, by="placement")
    assert test.tolist() in tests


def test_placements_that_share_joints_stay_together():
    data = in_sockets(["low/0", "high/0", "far/0"])
    q = data.q.clone()
    q[1] = q[0]
    shared = Measurements(q=q, socket=data.socket)
    assert sorted(test.tolist() for _, test in k_folds(shared, None, 0, "placement")) == [[0, 1], [2]]


@pytest.mark.parametrize(
    ("names", "value"), [(["low/0", "low/1"], "low"), (["", ""], "no names of sockets or frames")]
)
def test_refuses_to_split_by_fewer_than_two_placements(names: list[str], value: str):
    position = torch.zeros(2, 3, dtype=torch.float64)
    data = in_sockets(names) if names[0] else Measurements(q=in_sockets(["a", "b"]).q, position=position)
    with refused(MeasurementError, value=value):
        k_folds(data, None, seed=0, by="placement")


def test_refuses_more_folds_than_placements():
    with refused(MeasurementError, option="folds", value=3):
        k_folds(in_sockets(["a/0", "b/0", "b/1"]), 3, seed=0, by="placement")


def test_repeats_differ_and_start_with_the_folds_of_the_seed():
    measurements = repeated([row // 3 for row in range(72)])
    found = repeated_k_folds(measurements, 6, seed=4)
    assert len(found) == 8  # 200 of 24 groups
    first = [test.tolist() for _, test in k_folds(measurements, 6, seed=4)]
    assert [test.tolist() for _, test in found[0]] == first
    assert len({tuple(tuple(test.tolist()) for _, test in folds) for folds in found}) == 8
    for folds in found:
        assert sorted(torch.cat([test for _, test in folds]).tolist()) == list(range(72))


@pytest.mark.parametrize(
    ("groups", "folds", "by", "times"),
    [
        (5, 2, "joints", 10),
        (100, 5, "joints", 2),
        (101, 5, "joints", 1),
        (12, 12, "joints", 1),
        (12, None, "joints", 1),
        (12, 3, "interleaved", 1),
        (12, 3, "time", 1),
    ],
)
def test_few_poses_get_several_repeats(groups: int, folds: int | None, by: SplitBy, times: int):
    assert len(repeated_k_folds(repeated(list(range(groups))), folds, seed=0, by=by)) == times


@pytest.mark.parametrize(("folds", "by"), [(4, "time"), (4, "interleaved"), (12, "joints")])
def test_refuses_repeats_that_would_be_equal(folds: int, by: SplitBy):
    measurements = repeated(list(range(12)))
    assert len(repeated_k_folds(measurements, folds, seed=0, by=by, repeats=1)) == 1
    with refused(MeasurementError, option="repeats", value=3):
        repeated_k_folds(measurements, folds, seed=0, by=by, repeats=3)
