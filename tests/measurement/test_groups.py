"""Rows that are held out together for model selection."""

import torch

from pisigma.measurement.dataset import Measurements
from pisigma.measurement.groups import groups_of_equal_joints, held_out_groups


def rows(count: int, **columns: object) -> Measurements:
    """Return rows of different joint values with the given fields."""
    return Measurements(q=torch.arange(2 * count, dtype=torch.float64).view(count, 2), **columns)  # type: ignore[arg-type]


def sockets(*names: str) -> Measurements:
    return rows(len(names), socket=names)


def test_sockets_of_a_placement_are_held_out_together():
    """Their order in the file does not matter."""
    measured = sockets("low/0", "high/0", "low/1", "plate/0", "high/1", "low/0", "plate/0")
    assert held_out_groups(measured).tolist() == [0, 1, 0, 2, 1, 0, 2]


def test_a_socket_without_a_placement_is_a_placement():
    assert held_out_groups(sockets("a", "b", "b", "c", "a")).tolist() == [0, 1, 1, 2, 0]


def test_fewer_than_three_placements_fall_back_to_their_sockets():
    measured = sockets("low/0", "high/0", "low/1", "high/1", "low/0")
    assert held_out_groups(measured).tolist() == [0, 1, 2, 3, 0]


def test_fewer_than_three_sockets_fall_back_to_equal_joints():
    measured = sockets("low/0", "low/1", "low/0", "low/1")
    assert held_out_groups(measured).tolist() == [0, 1, 2, 3]


def test_anchors_are_held_out_whole():
    names = ("wall", "floor", "wall", "door", "floor")
    distance = torch.ones(5, dtype=torch.float64)
    assert held_out_groups(rows(5, anchor=names, distance=distance)).tolist() == [0, 1, 0, 2, 1]
    one = rows(4, anchor=("wall",) * 4, distance=distance[:4])
    assert held_out_groups(one).tolist() == [0, 1, 2, 3]


def test_without_sockets_and_anchors_rows_of_equal_joints_are_a_group():
    q = torch.tensor([[1.0, 2.0], [0.0, 1.0], [1.0, 2.0], [3.0, 1.0]], dtype=torch.float64)
    measured = Measurements(q=q)
    assert held_out_groups(measured).tolist() == [0, 1, 0, 2]
    assert torch.equal(held_out_groups(measured), groups_of_equal_joints(q))


def test_equal_joints_in_two_sockets_join_these():
    """One joint vector cannot be both held out and kept."""
    names = ("a/0", "b/0", "c/0", "d/0", "a/0")
    q = torch.arange(10, dtype=torch.float64).view(5, 2)
    q[1] = q[4]
    assert held_out_groups(Measurements(q=q, socket=names)).tolist() == [0, 0, 1, 2, 0]


def test_rows_of_a_pair_and_rows_without_a_name_are_separate_groups():
    names = ("low/0", "", "high/0", "", "", "plate/0", "plate/1", "")
    pair = ("", "p", "", "p", "", "", "", "")
    distance = torch.full((8,), torch.nan, dtype=torch.float64)
    distance[[1, 3]] = 0.5
    measured = rows(8, socket=names, pair=pair, distance=distance)
    assert held_out_groups(measured).tolist() == [0, 1, 2, 1, 3, 4, 4, 5]


def test_joint_values_that_encoders_read_are_one_pose_and_those_along_a_path_are_not():
    random = torch.Generator().manual_seed(0)
    commanded = torch.rand(40, 6, generator=random, dtype=torch.float64) * 4 - 2
    read = commanded.repeat(5, 1) + 1e-4 * torch.randn(200, 6, generator=random, dtype=torch.float64)
    assert groups_of_equal_joints(read).tolist() == [*range(40)] * 5
    path = torch.linspace(0, 1, 2001, dtype=torch.float64)[:, None].expand(-1, 6)
    assert int(groups_of_equal_joints(path).max()) + 1 > 600
