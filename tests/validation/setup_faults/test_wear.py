"""Changes that neither wear nor a collision can cause are distinguished from others, by class of robots."""

import math
from dataclasses import replace

import pytest

from pisigma.lifetime.recalibration.motion import excessive_change_diagnostics
from pisigma.lifetime.recalibration.movement import Movement
from pisigma.robot.description import Robot
from pisigma.robot.robot_class import CLASSES, RobotClass

MAKERS = {"industrial": "FANUC", "cobot": "Franka", "hobby": "Niryo", "servo": "TheRobotStudio"}
KINDS = {
    "joint 2": "joint_zero",
    "joint 3": "joint_zero",
    "a_2": "length",
    "d_1": "length",
    "alpha_1": "angle",
}


def of_class(name: str) -> Robot:
    robot = replace(Robot.load("ur5"), maker=MAKERS[name])
    assert RobotClass.from_robot(robot).name == name
    return robot


def moved(what: str, size: float) -> Movement:
    """A change [m or rad]."""
    unit, factor = ("mm", 1e3) if KINDS[what] == "length" else ("deg", math.degrees(1.0))
    return Movement(what, size * factor, 1e-3, unit)


@pytest.mark.parametrize("name", CLASSES)
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("what", ["a_2", "d_1", "alpha_1"])
def test_lengths_and_angles_have_limits_of_the_class(name, sign, what):
    limit = getattr(RobotClass.from_robot(of_class(name)).max_changes, KINDS[what])
    assert excessive_change_diagnostics(of_class(name), [moved(what, 0.99 * sign * limit)]) == ()
    (found,) = excessive_change_diagnostics(of_class(name), [moved(what, 1.01 * sign * limit)])
    assert (found.kind, found.severity) == ("beyond_wear", "implausible")


@pytest.mark.parametrize("name", CLASSES)
def test_one_joint_may_be_zeroed_again_but_not_several(name):
    far = 1.01 * RobotClass.from_robot(of_class(name)).max_changes.joint_zero
    assert excessive_change_diagnostics(of_class(name), [moved("joint 2", 1.0)]) == ()
    assert (
        excessive_change_diagnostics(of_class(name), [moved("joint 2", 1.0), moved("joint 3", 0.5 * far)])
        == ()
    )
    assert (
        len(excessive_change_diagnostics(of_class(name), [moved("joint 2", 1.0), moved("joint 3", far)])) == 1
    )
    assert len(excessive_change_diagnostics(of_class(name), [moved("joint 2", 1.0), moved("a_2", 1.0)])) == 1


@pytest.mark.parametrize("what", ["base", "tool", "base cell"])
def test_frames_move_by_any_size(what):
    robot = of_class("industrial")
    assert (
        excessive_change_diagnostics(
            robot, [Movement(what, 6000.0, 0.1, "mm"), Movement(what, 90.0, 0.1, "deg")]
        )
        == ()
    )
    assert excessive_change_diagnostics(robot, []) == ()
