"""Rows beyond the nominal joint limits."""

import dataclasses

import numpy as np
import pytest
import torch
from testing.coupled import coupled_robot

from pisigma.files.errors import RobotError
from pisigma.files.yaml_file import parse_yaml
from pisigma.measurement.dataset import Measurements
from pisigma.measurement.exceeded_limits import exceeded_limits, row_warnings, with_limits_of_rows
from pisigma.robot import Robot
from pisigma.robot.robot_file import RobotDocument
from pisigma.robot.writing import robot_to_yaml


def rows_at(robot: Robot, q: np.ndarray) -> Measurements:
    """Return rows with the controller's values."""
    return Measurements(
        q=torch.from_numpy(robot.to_dh(q)),
        position=torch.zeros(len(q), 3, dtype=torch.float64),
        source="rows.csv",
    )


@pytest.mark.parametrize(
    "robot", [Robot.load("kiro3"), Robot.load("panda"), coupled_robot()], ids=lambda r: r.name
)
def test_limits_are_widened_exactly_to_the_rows(robot):
    lower, upper = robot.axis_limits.T
    q = np.stack([0.6 * lower + 0.4 * upper, 0.4 * lower + 0.6 * upper, 0.5 * (lower + upper)])
    assert with_limits_of_rows(robot, rows_at(robot, q)) is robot
    assert row_warnings(robot, rows_at(robot, q)) == ()
    q[1, 1], q[2, 2] = upper[1] + 0.01, lower[2] - 0.02
    rows = rows_at(robot, q)
    assert [(one.axis.name, one.rows) for one in exceeded_limits(robot, rows)] == [
        (robot.axes[1].name, (1,)),
        (robot.axes[2].name, (2,)),
    ]
    warnings = row_warnings(robot, rows)
    assert len(warnings) == 2
    assert all(
        robot.axes[1 + i].name in warning and rows.place(1 + i) in warning
        for i, warning in enumerate(warnings)
    )
    wide = with_limits_of_rows(robot, rows)
    change = wide.axis_limits - robot.axis_limits
    assert change[1, 1] == pytest.approx(0.01)
    assert change[2, 0] == pytest.approx(-0.02)
    assert np.count_nonzero(change) == 2
    assert exceeded_limits(wide, rows) == ()
    read = Robot(*parse_yaml(robot_to_yaml(wide), RobotDocument, RobotError, "file").to_fields())
    assert np.abs(read.limits - wide.limits).max() < 1e-12


def test_axes_without_limits_have_no_rows_beyond():
    robot = Robot.load("ur10")
    free = dataclasses.replace(
        robot, rows=tuple(dataclasses.replace(row, lower=-np.inf, upper=np.inf) for row in robot.rows)
    )
    assert exceeded_limits(free, rows_at(robot, np.full((2, 6), 100.0))) == ()
