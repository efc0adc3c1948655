"""Tasks from files of joint values and of poses."""

from pathlib import Path

import pytest
import torch
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused

from pisigma.files.errors import PisigmaError, PlanningError
from pisigma.planning.plan_settings import PlanSettings
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.task import TASK_POSES, task_joint_values
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import zyx_from_rotation


@pytest.mark.parametrize("kind", ["joints", "poses"])
def test_a_task_may_be_joint_values_or_poses(tmp_path: Path, kind: str):
    robot = Robot.load("fanuc_r2000")
    q = torch.deg2rad(
        torch.tensor([[10.0, 20, 5, 30, 40, 50], [-20, 10, 15, 30, -40, 50]], dtype=torch.float64)
    )
    T = forward_kinematics(robot, q)
    if kind == "joints":
        rows = [
            ",".join(f"q{n}_deg" for n in range(1, 7)),
            *(",".join(map(str, row)) for row in q.rad2deg().tolist()),
        ]
    else:
        values = torch.cat([T[:, :3, 3] * 1e3, zyx_from_rotation(T[:, :3, :3]).rad2deg()], 1)
        rows = [
            "x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg",
            *(",".join(map(str, row)) for row in values.tolist()),
        ]
    (tmp_path / "task.csv").write_text("\n".join(rows))
    arm, settings = ArmInSurroundings.from_robot(robot), PlanSettings(task=str(tmp_path / "task.csv"))
    with no_type_checker():
        read = task_joint_values(arm, settings, q)
    assert_close(forward_kinematics(robot, read), T, atol=1e-9)
    (tmp_path / "task.csv").write_text(
        "\n".join(rows).replace(",", ",99", 3) if kind == "poses" else "q1_deg\n1"
    )
    with refused(PisigmaError, file="task.csv"), no_type_checker():
        task_joint_values(arm, settings, q)


@pytest.mark.parametrize(
    ("header", "value", "stated"),
    [("q3_deg", "400", "400 deg"), ("q3_rad", "10", "572.958 deg")],
)
def test_joint_values_of_a_task_outside_the_limits_are_refused(
    tmp_path: Path, header: str, value: str, stated: str
):
    columns = ["q1_deg", "q2_deg", header, "q4_deg", "q5_deg", "q6_deg"]
    (tmp_path / "task.csv").write_text(f"{','.join(columns)}\n0,0,0,0,0,0\n0,0,{value},0,0,0\n")
    arm, settings = (
        ArmInSurroundings.from_robot(Robot.load("ur10")),
        PlanSettings(task=str(tmp_path / "task.csv")),
    )
    with refused(PlanningError, file="task.csv", line=3) as caught, no_type_checker():
        task_joint_values(arm, settings, torch.zeros(1, 6, dtype=torch.float64))
    assert caught.value.value == arm.robot.axes[2].name
    assert stated in str(caught.value)


def test_without_a_task_the_whole_workspace_is_used():
    q = torch.arange(4000.0, dtype=torch.float64).reshape(1000, 4)
    some = task_joint_values(ArmInSurroundings.from_robot(Robot.load("kiro3")), PlanSettings(), q)
    assert len(some) == TASK_POSES
    assert_close(some[[0, -1]], q[[0, -1]])
