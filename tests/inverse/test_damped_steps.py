"""Damped steps by matrices are those written out on components."""

import numpy as np
import pytest
import torch
from testing.calibrated_arm import joints_of
from testing.closeness import assert_close

from pisigma.inverse import newton_steps
from pisigma.inverse.fast_model import as_frame, entries_of
from pisigma.inverse.newton_steps import MovingArm
from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot import Robot


@pytest.mark.parametrize("away", [0.01, 0.5, 3.0])
def test_few_poses_go_the_way_of_many(monkeypatch, away):
    ends = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), np.array([0.1, 0.0, 0.2, 1.0, 0.2, 0.0])
    robot = Robot.load("ur10").with_geometry(base=ends[0], tool=ends[1])
    q = joints_of(robot, 40, seed=2)
    T = forward_kinematics(robot, q)
    start = (q + away * torch.sin(5 * q)).T.contiguous()
    found = []
    for few in (1000, 0):
        monkeypatch.setattr(newton_steps, "BY_MATRICES", few)
        arm = MovingArm(robot)
        found.append(arm.approach(arm.wanted(as_frame(entries_of(T))), start, newton_steps.BLOCK, 1e-9))
    assert not torch.equal(found[0], start)
    assert_close(found[0], found[1], atol=1e-7)
    error = arm.residual(arm.wanted(as_frame(entries_of(T))), found[0])
    if away < 0.1:
        assert float((error < 1e-6).double().mean()) > 0.9
