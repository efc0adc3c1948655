"""The table of targets, for any robot."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from testing.closeness import assert_close
from testing.hybrid import hybrid_of
from testing.models import hand_made_model, joints_around

from pisigma.deployment.export.geometry import frame_remarks
from pisigma.deployment.export.programs.targets import Targets, targets_of
from pisigma.deployment.export.targets import targets_csv
from pisigma.model.calibrated_model import CalibratedModel
from pisigma.model.geometric_model import model_of_hybrid
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.kinematics.status import Status
from pisigma.robot.se3 import transform_from_xyz_zyx


def rows_of(targets: Targets) -> list[dict[str, str]]:
    lines = [line for line in targets_csv(targets).splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def pose_in(row: dict[str, str]) -> torch.Tensor:
    lengths = [float(row[f"{name}_mm"]) / 1e3 for name in "xyz"]
    angles = [math.radians(float(row[f"{name}_deg"])) for name in ("roll", "pitch", "yaw")]
    return transform_from_xyz_zyx(torch.tensor([*lengths, *angles], dtype=torch.float64))


@pytest.mark.parametrize("name", ["kiro3", "kiro4", "ur10"])
def test_both_kinds_of_targets_reach_the_pose(name):
    model = hand_made_model(name)
    T = forward_kinematics(model.robot, joints_around(name, 7, seed=5, spread=0.1))
    targets = targets_of(CorrectedIK(model)(T), "poses.csv", tuple(range(2, 9)))
    rows = rows_of(targets)
    assert [row["line"] for row in rows] == ["2", "3", "4", "5", "6", "7", "8"]
    assert {(row["status"], row["branch"], row["sigma_mm"]) for row in rows} == {
        ("reached", model.branches[0], "")
    }
    for row, wanted in zip(rows, T, strict=True):
        q = torch.tensor(
            [
                math.radians(float(row[f"q{i}_deg"])) if turns else float(row[f"q{i}_mm"]) / 1e3
                for i, turns in enumerate(model.robot.revolute, 1)
            ],
            dtype=torch.float64,
        )
        assert_close(model.forward(q), wanted, atol=1e-9)
        assert_close(forward_kinematics(model.robot, q), pose_in(row), atol=1e-12)


def test_rows_without_target_are_empty():
    robot = Robot.load("ur10")
    status = tuple(Status)
    q = joints_around("ur10", len(status))
    targets = Targets(
        model="m",
        robot=robot,
        source="poses.csv",
        line=tuple(range(2, 2 + len(status))),
        status=status,
        branch=("only",) * len(status),
        q=q,
        T_nominal=forward_kinematics(robot, q),
        sigma=torch.full((len(status),), 2e-5, dtype=torch.float64),
    )
    given = torch.tensor([s in (Status.REACHED, Status.OUTSIDE_DOMAIN) for s in status])
    nan = replace(
        targets,
        q=q.where(given[:, None], torch.nan),
        T_nominal=targets.T_nominal.where(given[:, None, None], torch.nan),
        sigma=targets.sigma.where(given, torch.nan),
    )
    for row, s, there in zip(rows_of(nan), status, given.tolist(), strict=True):
        assert row["status"] == s.name.lower()
        values = [cell for name, cell in row.items() if name not in ("line", "status", "branch")]
        assert len(values) == 13
        assert all(values) if there else not any(values)


def test_a_pose_out_of_reach_has_no_target():
    model = hand_made_model("kiro4")
    T = forward_kinematics(model.robot, joints_around("kiro4", 2, seed=5, spread=0.1))
    T[1, 0, 3] = 9.0
    targets = targets_of(CorrectedIK(model)(T), "poses.csv", (2, 5))
    first, second = rows_of(targets)
    assert (first["status"], second["status"], second["q1_deg"], second["x_mm"]) == (
        "reached",
        "unreachable",
        "",
        "",
    )
    assert targets.failure_sentence == f"poses.csv, line 5: unreachable. {Status.UNREACHABLE.sentence}"


def test_targets_of_a_hybrid_state_accuracy_and_frames():
    arm = hybrid_of(name="rb5", frames=True)
    model = model_of_hybrid("cell", arm.true.nominal, arm.result, arm.measurements)
    T = model.forward(arm.measurements.q[:4])
    solution = CorrectedIK(model)(T)
    targets = targets_of(solution, "poses.csv", (2, 3, 4, 5))
    rows = rows_of(targets)
    assert_close([float(row["sigma_mm"]) for row in rows], solution.accuracy * 1e3, rtol=1e-12)
    assert {
        row["sigma_mm"] for row in rows_of(targets_of(solution, "p.csv", (2, 3, 4, 5), accuracy=False))
    } == {""}
    drawn = arm.true.nominal.with_geometry(base=model.robot.base, tool=model.robot.tool)
    for row, q in zip(rows, solution.q, strict=True):
        assert_close(pose_in(row), forward_kinematics(drawn, q), atol=1e-12)
    text = targets_csv(targets)
    remarks = frame_remarks(model)
    assert "(wall, floor)" in remarks[0]
    assert all(f"# {remark}\n" in text for remark in remarks)
    assert f"rb5; base: x_mm {model.robot.base[0] * 1e3:.9g}, " in text


def test_the_nominal_robot_is_described_in_comment_lines():
    robot = Robot.load("ur10").with_geometry(base=np.array([0.1, 0, 0, 0, 0, -np.pi / 2]))
    model = CalibratedModel(
        name="two\nlines, ü",
        kind="geometric_calibration",
        robot=robot,
        network=None,
        domain=None,
        branches=(),
        starts=joints_around("ur10", 5),
    )
    q = joints_around("ur10", 1)
    text = targets_csv(targets_of(CorrectedIK(model)(forward_kinematics(robot, q)), "poses.csv", (2,)))
    head, columns, row = text.splitlines()[:-2], text.splitlines()[-2], text.splitlines()[-1]
    assert all(line.startswith("# ") for line in head)
    assert "base: x_mm 100, y_mm 0, z_mm 0, roll_deg 0, pitch_deg 0, yaw_deg -90; tool: x_mm 0," in "".join(
        head
    )
    assert columns.startswith("line,status,branch,q1_deg")
    assert row.startswith("2,")
