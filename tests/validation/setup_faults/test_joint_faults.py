"""Maps of logged joint values: what they do, and that every fault appears once."""

import torch
from testing.closeness import assert_close
from testing.coupled import coupled_robot

from pisigma.robot import Robot
from pisigma.validation.setup_faults.joint_faults import (
    JointMaps,
    coupled_joints,
    joint_causes,
    joint_order_maps,
    joint_unit_maps,
    moved_zeros,
    quarter_turned_zeros,
    reversed_signs,
)


def test_joint_maps(generator):
    q = torch.rand(5, 4, generator=generator, dtype=torch.float64)
    assert_close(JointMaps.unchanged(2, 4).apply(q), q.expand(2, 5, 4), atol=0.0)
    matrix = torch.tensor([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 2, 0], [0, 0, -1, 1]]).double()
    maps = JointMaps(matrix[None], torch.ones(1, 4).double())
    expected = torch.stack([q[:, 1] + 1, -q[:, 0] + 1, 2 * q[:, 2] + 1, q[:, 3] - q[:, 2] + 1], -1)
    assert_close(maps.apply(q)[0], expected, atol=1e-15)
    assert_close(
        moved_zeros(torch.tensor([2]), torch.tensor([0.5]).double(), 4).apply(q)[0, :, 2], q[:, 2] + 0.5
    )


def test_every_fault_appears_once_and_changes_something():
    scara, arm = Robot.load("kiro3"), Robot.load("ur5")
    counts = {
        "signs": (reversed_signs(6), 2**6 - 1),
        "orders": (joint_order_maps(6), 719),
        "orders of many": (joint_order_maps(8), 28),
        "pairs": (coupled_joints(6), 2 * 6 * 5),
        "units": (joint_unit_maps(arm), 2 * (2**6 - 1) + 2),
        "units with a sliding joint": (joint_unit_maps(scara), 2 * (2**3 - 1) + 2 + 2),
        "zeros": (quarter_turned_zeros(arm), 4**6 - 1),
        "zeros that a base does not absorb": (quarter_turned_zeros(arm, "base"), 4**5 - 1),
        "zeros that base and tool do not absorb": (quarter_turned_zeros(arm, "base and tool"), 4**4 - 1),
    }
    for name, (maps, count) in counts.items():
        rows = torch.cat([maps.matrix.flatten(1), maps.offset], 1)
        assert len(rows) == count, name
        assert len(torch.unique(rows, dim=0)) == count, name
        unchanged = JointMaps.unchanged(1, maps.offset.shape[1])
        same = torch.cat([unchanged.matrix.flatten(1), unchanged.offset], 1)
        assert not bool((rows == same).all(1).any()), name


def test_the_advice_on_coupled_joints_depends_on_a_stated_coupling():
    (unstated,) = joint_causes(coupled_joints(6), 0, Robot.load("ur5"))
    (stated,) = joint_causes(coupled_joints(6), 0, coupled_robot())
    assert (unstated.kind, unstated.joints, unstated.clause) == (stated.kind, stated.joints, stated.clause)
    assert unstated.advice != stated.advice
