"""Programs of planned poses wait at poses and pass waypoints."""

from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close

from pisigma.deployment.export.programs.planned import planned_program
from pisigma.planning.plan_file import StoredPlan
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.robot import Robot

Q = torch.deg2rad(torch.arange(24, dtype=torch.float64).reshape(4, 6))
PLAN = StoredPlan(
    ArmInSurroundings.from_robot(Robot.load("fanuc_r2000")),
    PlanSettings(settling_s=2.5),
    None,
    Q[[0, 3]],
    torch.tensor([False, True]),
    torch.tensor([4, 7]),
    (Q[:0], Q[1:3]),
)
STOPS = ["pose 1", "waypoint", "waypoint", "pose 2"]


@pytest.mark.parametrize(
    ("name", "label", "wait"),
    [
        ("go.script", "  # ", "sleep(2.5)"),
        ("go.src", "; ", "WAIT SEC 2.5"),
        ("go.mod", "    ! ", "WaitTime 2.5;"),
        ("go.ls", "  !", "WAIT 2.50(sec)"),
    ],
)
def test_a_program_passes_waypoints_and_waits_at_poses(name: str, label: str, wait: str):
    lines = planned_program(PLAN, Path(name)).replace("\r\n", "\n").splitlines()
    at = [
        number
        for number, line in enumerate(lines)
        if any(line.removesuffix(" ;").endswith(label + s) for s in STOPS)
    ]
    assert [lines[number].removesuffix(" ;").split(label)[-1] for number in at] == STOPS
    waits = [number for number, line in enumerate(lines) if wait in line]
    assert [sum(number < end for number in at) for end in waits] == [1, 4]
    assert any("2 planned poses" in line for line in lines)


def test_joint_values_are_those_of_the_plan():
    text = planned_program(PLAN, Path("go.src"))
    values = [
        [float(word.split()[1]) for word in line[11:-2].split(", ")]
        for line in text.splitlines()
        if "PTP" in line
    ]
    assert_close(values, Q.rad2deg(), atol=1e-6)
