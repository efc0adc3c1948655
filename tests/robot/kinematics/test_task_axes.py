"""Tool axes and tolerances of a task: options, errors and Jacobians."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.models import joints_around
from testing.refusals import refused

from pisigma.files.errors import PoseError
from pisigma.robot import Robot
from pisigma.robot.kinematics.jacobian import joint_jacobian
from pisigma.robot.kinematics.task_axes import AXES, MAX_TILT, WHOLE, TaskAxes, default_axes, task_axes
from pisigma.robot.kinematics.task_error import task_error

INF = math.inf


@pytest.mark.parametrize(
    ("joints", "ignored"),
    [(3, AXES[3:]), (4, ("roll", "pitch")), (5, ("yaw",)), (6, ()), (7, ()), (8, ())],
)
def test_defaults_go_by_the_number_of_joints(joints, ignored):
    assert default_axes(joints).ignored == ignored
    assert task_axes(default_axes(joints), ()).ignored == ()
    assert task_axes(default_axes(joints), ("z", "yaw")).ignored == ("z", "yaw")


def test_tolerances_are_stated_once_or_for_each_axis():
    axes = task_axes(WHOLE, "yaw", tolerance_mm=0.5, tolerance_deg=[1.0, 2.0, 3.0])
    assert_close(axes.tolerance[:5], [5e-4, 5e-4, 5e-4, math.radians(1), math.radians(2)])
    assert axes.tolerance[5] == INF  # which is ignored all the same
    assert default_axes(4).tolerance == (0, 0, 0, -MAX_TILT, -MAX_TILT, 0)
    assert_close(axes.loose_weights[:3], [1.0] * 3)


@pytest.mark.parametrize(
    "stated",
    [
        {"ignore_axes": "rol"},
        {"tolerance_mm": -1.0},
        {"tolerance_deg": [1.0, 2.0]},
        {"tolerance_deg": math.inf * -1},
    ],
)
def test_invalid_tasks_are_rejected(stated):
    ((option, value),) = stated.items()
    with refused(PoseError, option=option, value=value):
        task_axes(WHOLE, **stated)


def test_a_tolerance_that_is_not_a_number_is_rejected():
    with refused(PoseError, option="tolerance_deg"):
        task_axes(WHOLE, tolerance_deg=math.nan)


@pytest.mark.parametrize(
    ("tolerance", "pivot"),
    [
        ((0,) * 6, -1),
        ((0, INF, 0, 0, 0, 0), -1),
        ((0, 0, 0, INF, 0, 0), 0),
        ((0, 0, 0, INF, INF, 0), 2),
        ((0, 0, 0, -0.1, -0.1, 0), 2),
        ((0, 0, 0, 0, 0.1, 0), 1),
        ((0, 0, 0, INF, INF, INF), -1),
        ((0, 0, 0, 0.1, 0.1, 0.1), -1),
    ],
)
def test_errors_and_their_derivatives_agree(tolerance, pivot):
    """All errors near the desired pose; twists and positions also far from it."""
    axes, robot, step = TaskAxes(tuple(map(float, tolerance))), Robot.load("ur10"), 1e-6
    assert axes.pivot == pivot
    q = joints_around("ur10", 6, spread=0.6)
    wanted, _ = joint_jacobian(robot, q.flip(0))
    for T, exact in ((joint_jacobian(robot, q + 1e-7)[0], range(6)), (wanted, (0, 1, 2, 3 + pivot))):
        reached, J = joint_jacobian(robot, q)
        _, turn = task_error(axes, T, reached)
        for joint in range(6):
            ends = []
            for sign in (1.0, -1.0):
                moved = q.clone()
                moved[:, joint] += sign * step
                ends.append(task_error(axes, T, joint_jacobian(robot, moved)[0])[0])
            slope = (ends[0] - ends[1]) / (2 * step)
            for row in exact:
                if row > 2 or pivot < 0 or exact != range(6):
                    assert_close(slope[:, row], -(turn @ J)[:, row, joint], atol=2e-6)


def test_an_ignored_axis_does_not_affect_the_others():
    q = joints_around("ur10", 20, spread=0.8)
    T, _ = joint_jacobian(Robot.load("ur10"), q)
    angle = torch.linspace(-3.1, 3.1, 20, dtype=torch.float64)
    turned = T.clone()
    turned[:, :3, 0] = angle.cos()[:, None] * T[:, :3, 0] + angle.sin()[:, None] * T[:, :3, 1]
    turned[:, :3, 1] = angle.cos()[:, None] * T[:, :3, 1] - angle.sin()[:, None] * T[:, :3, 0]
    error, _ = task_error(TaskAxes((0.0, 0.0, 0.0, 0.0, 0.0, INF)), turned, T)
    assert_close(error[:, :5], 0.0, atol=1e-14)
    assert_close(error[:, 5], angle, atol=1e-13)
    assert WHOLE.is_exact
    assert len(WHOLE.row) == 0
