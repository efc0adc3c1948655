"""Measured stretches of joint values, and the arm with its correction, there and beyond."""

import math

import numpy as np
import torch
from testing.closeness import assert_close
from testing.linearised import random_joints
from torch import Tensor

from pisigma.calibration.hybrid.arm import HybridArm, JointCoverage
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.joint_correction.joint_correction import JointCorrection
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics


def line(*ends: tuple[float, float], count: int = 40) -> Tensor:
    """Angles [rad] all over some stretches [deg]."""
    return torch.cat([torch.linspace(low, high, count, dtype=torch.float64) for low, high in ends]).deg2rad()


def coverage_of(first: Tensor, name: str = "ur5", joint: int = 0) -> JointCoverage:
    """Of a robot whose other joints were measured all over a turn."""
    robot = Robot.load(name)
    q = random_joints(robot, len(first), 0)
    columns = [torch.linspace(-np.pi, np.pi, len(first), dtype=torch.float64)] * robot.dof
    q = torch.stack(columns, 1) if all(robot.revolute) else q
    q[:, joint] = first
    return JointCoverage.from_joints(robot, q)


def beyond(coverage: JointCoverage, *angles: float) -> Tensor:
    """Of values of the first joint [deg], in degrees."""
    q = torch.zeros(len(angles), len(coverage.is_periodic), dtype=torch.float64)
    q[:, 0] = torch.tensor(angles, dtype=torch.float64).deg2rad()
    return coverage.distance_outside(q)[:, 0].rad2deg()


def test_a_gap_wider_than_allowed_was_not_measured_and_a_narrower_one_was() -> None:
    found = coverage_of(line((-90, -60), (-1, 30), (95, 150)))
    assert int((found.joint == 0).sum()) == 2
    assert_close(beyond(found, -90, -30, 15, 30, 95, 140), torch.zeros(6), atol=1e-9)
    expected = torch.tensor([10.0, 50.0, 20.0, 10.0, 15.0, 5.0]).double()
    assert_close(beyond(found, -100, -160, 250, 40, 80, 155), expected, atol=1e-9)


def test_a_stretch_may_reach_over_the_full_turn() -> None:
    found = coverage_of(line((150, 180), (-180, -100)))
    assert int((found.joint == 0).sum()) == 1
    assert_close(beyond(found, 180, -180, 155, 540, -105), torch.zeros(5), atol=1e-9)
    assert_close(
        beyond(found, 140, -90, 25, 380), torch.tensor([10.0, 10.0, 125.0, 120.0]).double(), atol=1e-9
    )


def test_two_stretches_one_of_them_over_the_full_turn() -> None:
    found = coverage_of(line((-20, 20), (100, 140)))
    assert int((found.joint == 0).sum()) == 2
    assert_close(
        beyond(found, -20, 10, 350, 120, 30, -30), torch.tensor([0.0, 0, 0, 0, 10, 10]).double(), atol=1e-9
    )


def test_a_joint_measured_all_around_has_nothing_beyond() -> None:
    found = coverage_of(line((-180, 160), count=100))
    assert_close(beyond(found, *range(-400, 400, 7)), torch.zeros(115))


def test_values_a_full_turn_apart_are_the_same_for_turning_joints_only() -> None:
    found = coverage_of(line((0, 40)))
    q = torch.linspace(-3, 3, 50, dtype=torch.float64)[:, None].expand(50, 6)
    assert_close(found.distance_outside(q + 2 * math.pi), found.distance_outside(q), atol=1e-12)
    sliding = coverage_of(torch.linspace(-0.3, -0.1, 50, dtype=torch.float64), "kiro3", 2)
    assert sliding.is_periodic == (True, True, False, True)
    travel = float(np.diff(Robot.load("kiro3").limits)[2, 0])
    q = torch.zeros(3, 4, dtype=torch.float64)
    q[:, 2] = torch.tensor([-0.2, -0.1 + 0.05, -0.3 - 2 * travel])
    expected = torch.tensor([0.0, 0.05, 2 * travel]).double() * math.pi / travel
    assert_close(sliding.distance_outside(q)[:, 2], expected, atol=1e-7)


def test_one_row_is_a_stretch_of_no_length() -> None:
    robot = Robot.load("ur5")
    q = torch.full((1, 6), 0.4, dtype=torch.float64)
    found = JointCoverage.from_joints(robot, q)
    assert_close(found.half_width, torch.zeros(6))
    assert found.contains(q).tolist() == [True]
    assert found.contains(q + 0.5).tolist() == [False]
    assert found.contains(q[0]).shape == ()
    assert found.contains(q.view(1, 1, 6)).shape == (1, 1)


def test_one_joint_beyond_its_measured_values_is_enough_but_rounding_is_not() -> None:
    found = JointCoverage.from_joints(Robot.load("ur5"), torch.zeros(1, 6, dtype=torch.float64))
    q = torch.tensor([[0.05, -0.1, 0.0, 0.0, 0.02, 0.0], [1e-10] * 6, [math.nan] * 6], dtype=torch.float64)
    assert_close(found.distance_outside(q)[0], q[0].abs())
    assert found.contains(q).tolist() == [False, True, False]


def test_the_correction_applies_inside_and_outside_the_measured_joint_values() -> None:
    robot = Robot.load("ur5")
    geometry = robot.with_geometry(dh=robot.dh + 1e-3)
    correction = JointCorrection(robot, (FourierSeries(robot, 2),)).requires_grad_(False)
    correction.linear[0].fill_(1e-3)
    inside = random_joints(robot, 300, 0, widest=0.8)
    arm = HybridArm(geometry, correction, JointCoverage.from_joints(robot, inside))
    outside = inside[:20] + torch.tensor([0.0, 0, 2.5, 0, 0, 0]).double()
    assert bool(arm.coverage.contains(inside).all())
    assert not bool(arm.coverage.contains(outside).any())
    q = torch.cat([inside, outside])
    T = arm.forward(q)
    assert_close(T, forward_kinematics(geometry, q + correction(q)), atol=1e-15)
    assert_close(arm.forward(q[-1]), T[-1], atol=1e-14)


def test_more_rows_widen_the_measured_stretches():
    before = coverage_of(line((-150.0, -120.0), (0.0, 30.0)))
    q = torch.zeros(2, 6, dtype=torch.float64)
    q[:, 0] = torch.tensor([60.0, 80.0]).double().deg2rad()
    after = before.with_rows(q)
    everywhere = torch.zeros(5, 6, dtype=torch.float64)
    everywhere[:, 0] = torch.tensor([-135.0, 15.0, 70.0, 110.0, -60.0]).double().deg2rad()
    assert before.contains(everywhere).tolist() == [True, True, False, False, False]
    assert after.contains(everywhere).tolist() == [True, True, True, False, False]
