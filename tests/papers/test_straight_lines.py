"""Straight lines are exact with the true parameters, and have the predicted deviations with wrong ones."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import UnreachablePoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import rotation_from_zyx, transform
from pisigma.simulation.commanded import BranchSection
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection
from straight_lines import Controller, i_move, move_l

BRANCH = BranchSection(name="front/elbow_up/no_flip")
NOMINAL = Robot.load("welding")
ERRORS = {"theta_1": {"a_mm": -4.72}, "theta_3": {"theta_deg": 0.48}, "theta_4": {"d_mm": 2.8}}


def true_robot(rows: dict | None = None, tool: dict | None = None) -> TrueRobot:
    error = {"kind": "geometric", "rows": rows or {}, "tool": tool or {}}
    return TrueRobotSection(robot="welding", errors=(error,)).true_robot()


def ends(start: tuple, end: tuple) -> torch.Tensor:
    R = rotation_from_zyx(torch.deg2rad(torch.tensor([180.0, -145, 0], dtype=torch.float64)))
    return transform(R.expand(2, 3, 3), torch.tensor([start, end], dtype=torch.float64))


LINE = ends((1.0, -0.4, 0.05), (1.0, 0.4, 0.05))
SHIFT = torch.tensor([0, 0.8, 0], dtype=torch.float64)


@pytest.mark.parametrize("rows", [ERRORS, ERRORS | {"theta_2": {"beta_deg": 0.3}}])
def test_with_the_true_parameters_lines_are_straight(rows: dict):
    true = true_robot(rows)
    controller = Controller(NOMINAL, true.true_geometry, BRANCH)
    assert controller.is_closed_form == ("theta_2" not in rows)
    for line in (move_l(true, controller, LINE), i_move(true, controller, LINE[0], SHIFT)):
        assert line.wanted.shape == (101, 3)
        assert_close(line.deviation, torch.zeros(101, 3), atol=1e-9)
        assert_close(line.length_error, 0.0, atol=1e-9)
        assert_close(line.largest_across, 0.0, atol=1e-9)


def test_taught_end_points_are_exact_and_the_middle_deviates():
    true, controller = true_robot(ERRORS), Controller(NOMINAL, NOMINAL, BRANCH)
    line = move_l(true, controller, LINE, steps=21)
    assert_close(line.deviation[[0, -1]], torch.zeros(2, 3), atol=1e-9)
    assert_close(line.length_error, 0.0, atol=1e-9)
    assert float(line.largest_across) > 1e-3
    assert_close(line.largest.abs(), line.deviation.abs().amax(0))
    away = line.reached - line.wanted[0]
    assert_close(line.largest_across, away[:, [0, 2]].norm(dim=-1).max(), rtol=1e-12)


def test_only_the_start_of_an_i_move_is_exact():
    true, controller = true_robot(ERRORS), Controller(NOMINAL, NOMINAL, BRANCH)
    line = i_move(true, controller, LINE[0], SHIFT)
    assert_close(line.deviation[0], torch.zeros(3), atol=1e-9)
    assert_close(line.wanted[-1], LINE[1, :3, 3], atol=1e-12)
    assert_close(line.length_error, (line.reached[-1] - line.reached[0]).norm() - 0.8, atol=1e-15)
    assert abs(line.length_error) > 1e-3


def test_a_wrong_tool_does_not_bend_lines_of_one_orientation():
    true, controller = true_robot(tool={"x_mm": 4, "z_mm": -7}), Controller(NOMINAL, NOMINAL, BRANCH)
    assert_close(move_l(true, controller, LINE).deviation, torch.zeros(101, 3), atol=1e-9)
    assert_close(i_move(true, controller, LINE[0], SHIFT).deviation, torch.zeros(101, 3), atol=1e-9)


def test_a_wrong_zero_of_the_first_joint_rotates_an_i_move():
    angle = 0.5
    true, controller = true_robot({"theta_1": {"theta_deg": angle}}), Controller(NOMINAL, NOMINAL, BRANCH)
    line = i_move(true, controller, LINE[0], SHIFT)
    assert_close(line.length_error, 0.0, atol=1e-9)
    half = math.radians(angle) / 2
    assert_close(line.deviation[-1].norm(), 2 * 0.8 * math.sin(half), atol=1e-9)
    assert_close(line.largest_across, 0.8 * math.sin(2 * half), atol=1e-9)


def test_a_controller_without_a_closed_form_reaches_its_poses():
    robot = true_robot(ERRORS | {"theta_2": {"alpha_deg": 0.2}}).true_geometry
    controller = Controller(NOMINAL, robot, BRANCH)
    assert not controller.is_closed_form
    assert_close(forward_kinematics(robot, controller.joints(LINE)), LINE, atol=1e-9)


def test_lines_out_of_reach_are_refused():
    far = ends((1.0, -0.4, 0.05), (2.0, 0.4, 0.05))
    true, controller = true_robot(), Controller(NOMINAL, NOMINAL, BRANCH)
    with refused(UnreachablePoseError, value=1) as caught:
        move_l(true, controller, far)
    assert all(number in str(caught.value) for number in ("2000.0", "400.0", "50.0"))
    with pytest.raises(UnreachablePoseError):
        i_move(true, controller, LINE[0], 3 * SHIFT)
