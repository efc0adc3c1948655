"""Rows without positions: a moved tool, also along directions that the orientations of the rows do not determine."""

from dataclasses import replace

import numpy as np
import pytest
from testing.closeness import assert_close
from testing.identified import geometric_model
from testing.touches import TIP, random_noise, touches, touching_joints

from pisigma.robot import Robot
from pisigma.validation.checks.other_sensors import _fitted
from pisigma.validation.gate import check_rows

MOVED = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("axis", [0, None])
def test_moved_tool_is_found_by_touches_about_one_axis_or_all(axis):
    robot = Robot.load("ur5").with_geometry(tool=TIP + MOVED)
    frames = {"bases": {"": robot.base}, "tools": {"": robot.tool}}
    model = replace(geometric_model("ur10"), robot=robot, calibrated=robot, **frames)
    rows = touches(touching_joints(8, axis=axis), random_noise(8, 1))
    (found,) = check_rows(rows, model).implausible_findings
    assert found.cause == "tool"
    left, moved = _fitted(model, rows, range(6, 9))
    assert left < 2e-4
    assert_close(moved[6:], -MOVED[:3], atol=5e-4)
