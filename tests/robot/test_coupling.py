"""Coupled joints: conversion between controller values and joint values, and its description in files."""

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.coupled import COUPLED, PALLETISER, coupled_robot
from testing.refusals import refused

from pisigma.files.errors import PoseError, RobotError
from pisigma.robot import Robot
from pisigma.robot.coupling import FourBar
from pisigma.robot.kernels.array_kinematics import forward_kinematics
from pisigma.robot.writing import robot_to_yaml

DEG = np.pi / 180


def drawn(robot: Robot, count: int = 200) -> np.ndarray:
    lower, upper = robot.axis_limits.T
    return np.random.default_rng(0).uniform(lower, upper, (count, len(lower)))


def test_a_joint_follows_the_controller_values_as_stated():
    robot = coupled_robot()
    q = drawn(robot)
    expected = q.copy()
    expected[:, 2] = q[:, 2] + q[:, 1]
    assert_close(robot.to_dh(q), expected, atol=0)
    assert_close(robot.limits[2], np.array([-132 - 60, 220 + 76]) * DEG, atol=1e-15)
    assert_close(robot.axis_limits[2], np.array([-132, 220]) * DEG, atol=1e-15)


@pytest.mark.parametrize("text", [COUPLED, PALLETISER])
@pytest.mark.parametrize("shape", [(), (1,), (3, 1, 2)])
def test_controller_values_are_restored_for_arrays_and_tensors(text, shape):
    robot = coupled_robot(text)
    q = drawn(robot, int(np.prod(shape))).reshape(*shape, -1)
    assert_close(robot.to_controller(robot.to_dh(q)), q, atol=1e-12)
    tensor = torch.from_numpy(q)
    assert_close(robot.to_dh(tensor), robot.to_dh(q), atol=1e-15)
    assert_close(robot.to_controller(robot.to_dh(tensor)), q, atol=1e-12)


@pytest.mark.parametrize("text", [COUPLED, PALLETISER])
def test_a_coupled_robot_is_restored_from_its_file(tmp_path, text):
    robot = coupled_robot(text)
    file = tmp_path / "robot.yaml"
    file.write_text(robot_to_yaml(robot))
    again, q = Robot.load(file), drawn(robot)
    assert_close(again.to_dh(q), robot.to_dh(q), atol=1e-14)
    assert_close(again.limits, robot.limits, atol=1e-14)
    assert_close(again.axis_limits, robot.axis_limits, atol=1e-14)


def test_joint_values_are_not_accepted_as_axis_values():
    robot = coupled_robot(PALLETISER)
    q = np.zeros(robot.dof)
    with refused(PoseError, expected=f"{robot.dof - 1} values along the last axis", value=(robot.dof,)):
        robot.to_dh(q)
    with refused(PoseError, expected=f"{robot.dof - 1} values along the last axis", value=(robot.dof,)):
        forward_kinematics(robot, q)


def test_without_coupling_the_joints_are_the_axes():
    robot = Robot.load("ur5")
    q = drawn(robot, 3)
    assert robot.axes is robot.joints
    assert robot.to_dh(q) is q
    assert robot.to_controller(q) is q


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (1.0, -1.0, 0.0), (-1.0, -1.0, -1.0), (1.0, 0.0, 0.0)])
def test_a_joint_has_an_approach_direction_if_all_its_axes_agree(sides):
    coupling = coupled_robot().coupling
    side = coupling.approach_to_dh(np.array([0.0, *sides[:2], 0.0, 0.0, 0.0]))
    assert_close(side[1:3], [sides[0], sides[2]], atol=0)


def test_full_turns_bring_controller_values_into_their_limits():
    robot = coupled_robot()
    q = robot.to_dh(drawn(robot))
    turned, inside = robot.coupling.wrapped_within_limits(q + 2 * np.pi * np.array([0, 1, -1, 0, 0, 0]))
    assert inside.all()
    assert_close(turned, q, atol=1e-12)
    beyond = robot.to_dh(np.deg2rad([[0, 0, 224.0, 0, 0, 0]]))
    assert not robot.coupling.wrapped_within_limits(beyond)[1].any()


def test_only_a_parallelogram_rotates_with_its_crank():
    x = np.linspace(-1.0, 1.0, 21)
    assert_close(FourBar(1.0, 0.4, 1.0, 0.4, 1.5).joint_value(x), x, atol=1e-14)
    bar = FourBar(1.0, 0.4, 1.003, 0.401, 1.5)
    psi, phi = x + 1.5, bar.joint_value(x) + 1.5
    ends = np.exp(1j * psi) * 0.4 - (1.0 + np.exp(1j * phi) * 0.401)
    assert_close(np.abs(ends), np.full(21, 1.003), atol=1e-14)
    assert_close(bar.crank_rotation(bar.joint_value(x)), x, atol=1e-12)
    assert np.abs(phi - psi).max() > 1e-3


def test_the_slope_is_the_derivative():
    robot = coupled_robot(PALLETISER)
    q, step = drawn(robot, 5), 1e-6
    slope = robot.coupling.derivative(q)
    for axis in range(len(robot.axes)):
        moved = np.zeros(len(robot.axes))
        moved[axis] = step
        difference = (robot.to_dh(q + moved) - robot.to_dh(q - moved)) / (2 * step)
        assert_close(slope[..., axis], difference, atol=1e-8)


BAR = "four_bar: {ground_mm: 9, crank_mm: 1, coupler_mm: 1, rocker_mm: 1, zero_deg: 90}"


@pytest.mark.parametrize(
    ("old", "new", "expected", "value"),
    [
        ("joint: theta_3", "joint: theta_9", "", "theta_9"),
        ("theta_2: 1", "theta_8: 1", "", "theta_8"),
        ("theta_3: 1}", "theta_3: 1}, offset_mm: 2", "offset_deg and limits_deg", "theta_3"),
        ("theta_3: 1}}", "theta_3: 1}}\n  - {joint: theta_3, factors: {theta_3: 1}}", "", "theta_3"),
        ("theta_2: 1, theta_3: 1", "theta_2: 1", "no limits", "theta_3"),
        (
            "theta_3: 1}}",
            "theta_3: 1}}\n  - {joint: theta_2, factors: {theta_2: 1, theta_3: 1}}",
            "rank 6",
            5,
        ),
        ("theta_3: 1}", f"theta_3: 1}}, {BAR}", "a linkage that closes within the limits", 3),
    ],
)
def test_invalid_couplings_are_rejected(old, new, expected, value):
    assert old in COUPLED
    with refused(RobotError, option="coupling", expected=expected, value=value):
        coupled_robot(COUPLED.replace(old, new))


def test_a_screw_moves_by_millimetres_per_degree():
    text = """\
name: screw
maker: nobody
source: made up
rows:
  - {name: turn, type: revolute, limits_deg: [-180, 180]}
  - {name: stroke, type: prismatic, limits_mm: [0, 200]}
coupling:
  - {joint: stroke, factors: {stroke: 1, turn: 0.05}, offset_mm: 3}
"""
    robot = coupled_robot(text)
    assert_close(robot.to_dh(np.array([np.pi / 2, 0.1])), [np.pi / 2, 0.1 + 0.0045 + 0.003], atol=1e-15)
    assert_close(robot.limits[1], [0.003 - 0.009, 0.203 + 0.009], atol=1e-15)
    again = coupled_robot(robot_to_yaml(robot))
    assert_close(again.to_dh(np.array([1.0, 0.1])), robot.to_dh(np.array([1.0, 0.1])), atol=1e-15)
