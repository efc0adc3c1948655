"""Compiled kernels compared with torch: poses, Jacobians, corrections, and excess over measured joint values."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close

from pisigma.model.calibrated_model import hybrid_motion
from pisigma.robot.kernels.arrays import IDENTIFIED, NOMINAL, NOMINAL_WITHOUT_BASE
from pisigma.robot.kinematics.jacobian import joint_jacobian

NAMES = ["kiro3", "kiro4", "ur5", "rb5", "panda"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("arm", [NOMINAL, IDENTIFIED, NOMINAL_WITHOUT_BASE])
def test_poses_and_jacobians_agree_with_torch(name, arm, arms):
    model, q = arms.calibrated(name), arms.draw_joints(arms.calibrated(name).robot, 200, seed=4, share=1.5)
    robot = {NOMINAL: model.robot, IDENTIFIED: model.hybrid.robot, NOMINAL_WITHOUT_BASE: model.nominal}[arm]
    T, J = joint_jacobian(robot, q)
    found = arms.compiled(name).forward(q.numpy(), arm)
    assert_close(found[0], T, atol=1e-13)
    assert_close(found[1], J, atol=1e-13)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("joints", [False, True])
def test_corrections_agree_with_torch(name, joints, arms):
    model = arms.calibrated(name, joints=joints)
    q = arms.draw_joints(model.robot, 200, seed=4, share=1.5)
    _, _, delta, _ = arms.compiled(name, joints=joints).forward(q.numpy())
    assert np.abs(delta).max() > 1e-4
    assert_close(delta, model.hybrid.correction(q), atol=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_hybrid_arms_agree_with_torch_inside_and_beyond_measured_joint_values(name, arms):
    model = arms.calibrated(name, covered=0.5)
    q = arms.draw_joints(model.robot, 400, seed=4, share=0.6)
    T, J, _, beyond = arms.compiled(name, covered=0.5).forward(q.numpy())
    assert 10 < (beyond > 0).sum() < 390
    assert_close(beyond, model.hybrid.coverage.distance_outside(q).amax(-1), atol=1e-13)
    assert_close(T, model.hybrid.forward(q), atol=1e-13)
    assert_close(J, hybrid_motion(model.hybrid, q, exact=False)[1], atol=1e-13)


def test_without_a_hybrid_the_geometric_arm_moves(arms):
    model = arms.calibrated("ur5", hybrid=False)
    q = arms.draw_joints(model.robot, 20)
    T, _, delta, _ = arms.compiled("ur5", hybrid=False).forward(q.numpy())
    assert_close(T, joint_jacobian(model.calibrated, q)[0], atol=1e-13)
    assert_close(delta, torch.zeros_like(q))
