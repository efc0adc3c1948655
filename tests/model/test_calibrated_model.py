"""The forward kinematics of a calibrated model inverts its correction."""

from dataclasses import replace

import pytest
import torch
from testing.closeness import assert_close
from testing.models import HOMES, hand_made_model, joints_around

from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.joint_limits import nearest_turn


@pytest.mark.parametrize("name", HOMES)
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2), (0,)])
def test_forward_solves_its_equation(name, batch):
    model = hand_made_model(name)
    q_nominal = joints_around(name, *batch, seed=2)
    T = forward_kinematics(model.robot, q_nominal)
    assert_close(model.forward(q_nominal + model.correction(T, q_nominal)), T, atol=1e-11)


def test_without_network_it_is_the_robot():
    model = replace(hand_made_model("kiro4"), network=None, domain=None)
    q = joints_around("kiro4", 5)
    assert_close(model.forward(q), forward_kinematics(model.robot, q))
    assert_close(model.correction(model.forward(q), q), 0.0)


def test_nan_remains_in_its_row():
    model = hand_made_model("kiro4")
    q = joints_around("kiro4", 3)
    whole = model.forward(q)
    q[1, 2] = torch.nan
    T = model.forward(q)
    assert bool(T[1].isnan().all())
    assert_close(T[[0, 2]], whole[[0, 2]], atol=1e-12)


def test_a_correction_with_a_slope_above_one_yields_nan():
    model = hand_made_model("kiro4", scale=0.02)
    model.network.networks[0].output_scale.fill_(50.0)
    T = model.forward(joints_around("kiro4", 20))
    rows = T.isnan().flatten(1)
    assert bool(rows.any())
    assert torch.equal(rows.any(-1), rows.all(-1))


def test_wrapped_values_are_inside_the_limits_and_reach_the_pose():
    robot = hand_made_model("kiro3").robot  # theta_4 has limits of ±360 deg, d_3 is prismatic
    q = torch.tensor([3.0, 1.0, -0.2, 0.5], dtype=torch.float64)
    near = torch.tensor([-3.0, 40.0, 9.0, -7.0], dtype=torch.float64)
    inside = nearest_turn(robot, q, near, within_limits=True)
    assert_close(inside, torch.tensor([3.0, 1.0, -0.2, 0.5 - 2 * torch.pi], dtype=torch.float64), atol=1e-12)
    free = nearest_turn(robot, q, near, within_limits=False)
    assert_close(forward_kinematics(robot, free), forward_kinematics(robot, q), atol=1e-12)
    assert bool(((free - near).abs()[[0, 1, 3]] <= torch.pi).all())
    assert float(free[2]) == float(q[2])
