"""Plans of robots with coupled joints: the controller's values in files and for the operator."""

import csv
from pathlib import Path

import torch
from testing.closeness import assert_close
from testing.coupled import coupled_robot

from pisigma.planning.candidates import draw_candidates
from pisigma.planning.plan_file import StoredPlan, read_plan
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.session.state import NextPose
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings


def test_a_plan_holds_the_controllers_values_within_its_limits(tmp_path: Path) -> None:
    robot = coupled_robot()
    arm = ArmInSurroundings.from_robot(robot)
    q = draw_candidates(arm, 20, seed=1).q
    assert robot.coupling.is_within_limits(q.numpy()).all()
    count = len(q)
    way = (q[:1],) + (q[:0],) * (count - 1)
    check = torch.zeros(count, dtype=torch.bool)
    plan = StoredPlan(arm, PlanSettings(count=count), None, q, check, torch.arange(1, count + 1), way)
    plan.write(tmp_path / "plan.csv")
    with open(tmp_path / "plan.csv", newline="") as file:
        written = [[float(row[f"q{joint}_deg"]) for joint in range(1, 7)] for row in csv.DictReader(file)]
    assert_close(torch.deg2rad(torch.tensor(written, dtype=torch.float64)), robot.to_controller(q), atol=1e-7)
    again = read_plan(tmp_path / "plan.csv")
    assert_close(again.q, q, atol=1e-7)
    assert_close(again.waypoints[0], q[:1], atol=1e-7)


def test_the_message_states_what_the_controller_shows() -> None:
    robot = coupled_robot()
    values = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]).double()
    q = robot.to_dh(values)
    pose = NextPose(1, 2, q.numpy(), False, robot.to_controller(q.numpy()))
    assert_close(pose.controller_values, values, atol=1e-15)
    assert_close(NextPose(1, 2, q.numpy(), False).controller_values, q, atol=0)
