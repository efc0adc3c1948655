"""Candidate poses: drawn or read, allowed by the cell, and spread over the workspace."""

from pathlib import Path

import torch
from testing.cells import CELL
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.planning.candidates import draw_candidates, read_candidates, select_spread_poses
from pisigma.planning.surroundings.arm_in_surroundings import ArmInSurroundings
from pisigma.planning.surroundings.surroundings import Surroundings
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics

ARM = ArmInSurroundings.from_robot(Robot.load("fanuc_r2000"), CELL)


def test_candidates_are_allowed_and_the_same_at_every_draw():
    candidates = draw_candidates(ARM, 20, seed=1)
    again = draw_candidates(ARM, 20, seed=1)
    assert len(candidates.q) == 20
    assert bool(ARM.faults(candidates.q).allowed.all())
    assert_close(again.q, candidates.q)
    assert candidates.considered == int(candidates.number[-1]) == 20 + candidates.refused.total()


def test_the_reflector_remains_in_the_workspace():
    workspace = torch.tensor([[0.5, -2.0, 0.2], [2.5, 1.0, 2.5]], dtype=torch.float64)
    candidates = draw_candidates(ARM, 6, 0, workspace)
    position = forward_kinematics(ARM.robot, candidates.q)[:, :3, 3]
    assert bool(((position >= workspace[0]) & (position <= workspace[1])).all())
    assert any("workspace" in reason for reason in candidates.refused)


def test_candidates_of_a_file_keep_their_row(tmp_path: Path):
    drawn = draw_candidates(ARM, 5, 0)
    refused = torch.tensor([[0.0, 1.2, -1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    rows = torch.rad2deg(torch.cat([drawn.q[:2], refused, drawn.q[2:]])).tolist()
    path = tmp_path / "some.csv"
    path.write_text(
        "\n".join(["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"] + [",".join(map(repr, row)) for row in rows])
    )
    candidates = read_candidates(ARM, path)
    assert candidates.number.tolist() == [1, 2, 4, 5, 6]
    assert_close(candidates.q, drawn.q, atol=1e-12)


def test_repeated_poses_of_a_file_are_candidates_once(tmp_path: Path):
    drawn = draw_candidates(ARM, 4, 0)
    q = torch.cat([drawn.q, drawn.q + 1e-4, drawn.q[1:3]])  # as encoders read them
    path = tmp_path / "repeated.csv"
    rows = [",".join(map(repr, row)) for row in torch.rad2deg(q).tolist()]
    path.write_text("\n".join(["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg", *rows]))
    candidates = read_candidates(ARM, path)
    assert candidates.number.tolist() == [1, 2, 3, 4]
    assert candidates.refused == {"an earlier row has the same joint values": 6}


def test_too_few_candidates_are_refused_with_the_reasons():
    drawn = draw_candidates(ARM, 10, 0)
    with refused(PlanningError, value=10) as caught:
        drawn.check_count(50)
    assert drawn.sentence.rstrip(".") in str(caught.value)


def test_a_prismatic_joint_needs_limits():
    robot = Robot.load("kiro3")
    rows = tuple(row if row.type == "revolute" else type(row)(row.name, row.type) for row in robot.rows)
    arm = ArmInSurroundings.from_robot(Robot(robot.name, "", "", rows, robot.dh))
    with refused(PlanningError, value="d_3"):
        draw_candidates(arm, 5, 0)
    cell = Surroundings.model_validate({"joints": {"limits_mm": {"d_3": (-300.0, -10.0)}}})
    drawn = draw_candidates(ArmInSurroundings.from_robot(arm.robot, cell), 50, 0).q[:, 2]
    assert -0.3 <= float(drawn.min()) < float(drawn.max()) <= -0.01


def test_spread_poses_are_farther_apart_than_random_ones():
    q = draw_candidates(ArmInSurroundings.from_robot(ARM.nominal), 200, 0).q
    chosen = select_spread_poses(ARM, q[20:], 10, q[:20])
    position = forward_kinematics(ARM.robot, q)[:, :3, 3]

    def nearest(index: torch.Tensor) -> float:
        return float(torch.pdist(position[index]).min())

    assert len(chosen.unique()) == 10
    assert nearest(20 + chosen) > nearest(torch.arange(20, 30))
    assert len(select_spread_poses(ARM, q, 0, q[:3])) == 0


def test_joints_are_unwrapped_away_from_angles_that_are_rarely_free():
    arm = ArmInSurroundings.from_robot(
        Robot.load("ur5")
    )  # its wrist cannot fold against the forearm: joint 4 at 90 deg
    q = draw_candidates(arm, 400, 0).q[:, 3].rad2deg()
    assert float(q.min()) < -220
    assert float(q.max()) < 110
    assert float(q.max() - q.min()) < 360
