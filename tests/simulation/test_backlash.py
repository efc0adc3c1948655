"""Simulated backlash: joints stop short on the side from which they approach."""

import math

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import RecipeError
from pisigma.robot import Robot
from pisigma.simulation.errors.backlash import Backlash
from pisigma.simulation.measure import simulate
from pisigma.simulation.true_robot import TrueRobot, TrueRobotSection

ROBOT = Robot.load("rb5")
Q = torch.linspace(-1, 1, 60, dtype=torch.float64).reshape(10, 6)


def play(*degrees: float, **options: int) -> Backlash:
    names = [joint.name for joint in ROBOT.joints]
    return Backlash(kind="backlash", play_deg=dict(zip(names, degrees, strict=False)), **options)


def robot_at(q: torch.Tensor) -> torch.Tensor:
    return TrueRobot(ROBOT).forward(q)


def test_joints_stop_short_by_half_of_their_play():
    true = TrueRobot(ROBOT, [play(0.2, 0.0, 0.1), play(0.1)])
    approach = torch.tensor([1.0, 1.0, -1.0, 1.0, -1.0, 0.0], dtype=torch.float64).expand(Q.shape)
    expected = torch.tensor([-0.15, 0.0, 0.05, 0.0, 0.0, 0.0], dtype=torch.float64) * math.pi / 180
    assert_close(true.joint_error(Q, approach), expected.expand(Q.shape), atol=1e-15)
    assert_close(true.joint_error(Q), torch.zeros_like(Q), atol=0)
    assert_close(true.forward(Q, approach), robot_at(Q + expected), atol=1e-14)


def test_measurements_state_the_directions_of_approach():
    true = TrueRobot(ROBOT, [play(0.2, 0.2)])
    first, again = simulate(true, Q), simulate(true, Q)
    assert first.approach is not None
    assert set(first.approach.unique().tolist()) == {-1.0, 1.0}
    assert_close(first.approach, again.approach, atol=0)
    assert_close(first.position, true.forward(Q, first.approach)[:, :3, 3], atol=0)
    other = simulate(TrueRobot(ROBOT, [play(0.2, 0.2, seed=1)]), Q)
    assert bool((other.approach != first.approach).any())
    assert simulate(TrueRobot(ROBOT, [play()]), Q).approach is None


def test_recipes_accept_backlash_and_refuse_unknown_joints():
    section = {"robot": "rb5", "errors": [{"kind": "backlash", "play_deg": {ROBOT.joints[1].name: 0.1}}]}
    true = TrueRobotSection.model_validate(section).true_robot()
    assert float(true.half_play[1]) == pytest.approx(math.radians(0.05), rel=1e-12)
    with refused(RecipeError, value="elbow"):
        TrueRobot(ROBOT, [Backlash(kind="backlash", play_deg={"elbow": 0.1})])
