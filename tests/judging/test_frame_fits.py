"""Rigid transforms that fit best: exact data give them back, and nothing near fits better."""

import pytest
import torch
from testing.closeness import assert_close

from pisigma.judging.frame_fits import Seen, best_base, best_base_and_tool, best_tool
from pisigma.measurement.dataset import Measurements
from pisigma.robot import Robot
from pisigma.se3 import rotation_from_vector, transform, transform_from_xyzrpy
from pisigma.verification.joint_faults import (
    JointMaps,
    moved_zeros,
    other_orders,
    other_units,
    quarter_turned_zeros,
    turned_signs,
)

BASE = transform_from_xyzrpy(torch.tensor([0.3, -0.2, 0.1, 0.5, 0.2, -0.3], dtype=torch.float64))
TOOL = transform_from_xyzrpy(torch.tensor([0.03, -0.02, 0.05, 0.2, 0.1, 0.0], dtype=torch.float64))
LEVER = 0.2


@pytest.fixture
def T(generator):
    """Poses of a tool all over a cube."""
    turns = 2 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    places = torch.rand(40, 3, generator=generator, dtype=torch.float64)
    return transform(rotation_from_vector(turns), places)


def seen_of(T, turned: bool) -> Seen:
    rotation = T[:, :3, :3].contiguous() if turned else None
    rows = Measurements(
        q=torch.zeros(len(T), 1).double(), position=T[:, :3, 3].contiguous(), rotation=rotation
    )
    return Seen.of(rows, LEVER)


@pytest.mark.parametrize("turned", [False, True])
def test_exact_data_give_the_transforms_back(T, turned):
    tool = TOOL.clone() if turned else transform(torch.eye(3).double(), TOOL[:3, 3])
    assert_close(best_base(T, seen_of(BASE @ T, turned)), BASE, atol=1e-12)
    assert_close(best_tool(T, seen_of(T @ tool, turned)), tool, atol=1e-12)
    base, behind = best_base_and_tool(T, seen_of(BASE @ T @ tool, turned), reach=1.0)
    assert_close(base, BASE, atol=1e-9)
    assert_close(behind, tool, atol=1e-9)


@pytest.mark.parametrize("turned", [False, True])
def test_nothing_near_fits_better(T, generator, turned):
    spoilt = BASE @ T
    spoilt[:, :3, 3] += 0.05 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    seen = seen_of(spoilt, turned)
    for fit, behind in ((best_base, False), (best_tool, True)):
        X = fit(T, seen)
        least = seen.squares(T @ X if behind else X @ T).sum()
        steps = 1e-3 * torch.eye(6, dtype=torch.float64)
        for step in torch.cat([steps, -steps]):
            if behind and not turned and bool(step[3:].any()):
                continue  # a turn of the tool is not seen
            near = X @ transform(rotation_from_vector(step[3:]), step[:3])
            assert float(seen.squares(T @ near if behind else near @ T).sum()) > float(least)


def test_batches_equal_single_ones(T):
    batch = torch.stack([T, BASE @ T, T @ TOOL])
    seen = seen_of(T, True)
    for fit in (best_base, best_tool):
        assert_close(fit(batch, seen), torch.stack([fit(one, seen) for one in batch]), atol=1e-12)
    assert_close(seen.squares(batch)[0], torch.zeros(40), atol=1e-15)


def test_joint_maps(generator):
    q = torch.rand(5, 4, generator=generator, dtype=torch.float64)
    assert_close(JointMaps.unchanged(2, 4).of(q), q.expand(2, 5, 4), atol=0.0)
    maps = JointMaps(
        torch.tensor([[1, 0, 2, 3]]), torch.tensor([[1.0, -1, 2, 1]]).double(), torch.ones(1, 4).double()
    )
    expected = torch.stack([q[:, 1] + 1, -q[:, 0] + 1, 2 * q[:, 2] + 1, q[:, 3] + 1], -1)
    assert_close(maps.of(q)[0], expected, atol=1e-15)
    assert_close(
        moved_zeros(torch.tensor([2]), torch.tensor([0.5]).double(), 4).of(q)[0, :, 2], q[:, 2] + 0.5
    )


def test_every_mix_up_stands_once_and_changes_something():
    scara, arm = Robot.load("kiro3"), Robot.load("ur5")
    counts = {
        "signs": (turned_signs(6), 2**6 - 1),
        "orders": (other_orders(6), 719),
        "orders of many": (other_orders(8), 28),
        "units": (other_units(arm), 2 * (2**6 - 1)),
        "units with a sliding joint": (other_units(scara), 2 * (2**3 - 1) + 2),
        "zeros": (quarter_turned_zeros(arm), 4**6 - 1),
    }
    for name, (maps, count) in counts.items():
        rows = torch.cat([maps.order.double(), maps.factor, maps.offset], 1)
        assert len(rows) == count, name
        assert len(torch.unique(rows, dim=0)) == count, name
        unchanged = JointMaps.unchanged(1, maps.order.shape[1])
        same = torch.cat([unchanged.order.double(), unchanged.factor, unchanged.offset], 1)
        assert not bool((rows == same).all(1).any()), name
