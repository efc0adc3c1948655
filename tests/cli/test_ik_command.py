"""`pisigma ik`: poses in, corrected joint values out, and what cannot be reached."""

import csv
import json

import pytest
import torch
from testing.closeness import assert_close
from testing.models import HOMES, joints_around

from pisigma.correction.corrected_ik import load
from pisigma.kinematics.forward import forward_kinematics
from pisigma.robot import Robot
from pisigma.se3 import xyzrpy_from_transform

COLUMNS = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")


def pose_of(name: str, q: torch.Tensor) -> list[float]:
    """X Y Z ROLL PITCH YAW [mm, deg] of joint values."""
    values = xyzrpy_from_transform(forward_kinematics(Robot.load(name), q))
    return [*(values[:3] * 1e3).tolist(), *torch.rad2deg(values[3:]).tolist()]


def home_pose(name: str) -> list[float]:
    return pose_of(name, joints_around(name, seed=6, spread=0.1))


def write_poses(path, rows) -> None:
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("name", ["kiro4", "ur10"])
def test_json_of_a_robot_whose_joints_all_turn(run, models, name):
    result = run("ik", models / name, "--pose", *home_pose(name), "--json")
    assert result.exit_code == 0
    (solution,) = json.loads(result.stdout)["solutions"]
    expected = load(models / name)(
        forward_kinematics(Robot.load(name), joints_around(name, seed=6, spread=0.1))
    )
    assert solution["status"] == "reached"
    assert solution["branch"] == expected.branches[int(expected.branch)]
    for key, values in (
        ("q", expected.q),
        ("q_nominal", expected.q_nominal),
        ("correction", expected.correction),
    ):
        assert_close(solution[f"{key}_deg"], torch.rad2deg(values), atol=1e-8)
    assert 0 <= solution["domain_measure"] <= 1


def test_json_of_a_robot_with_a_sliding_joint(run, models):
    result = run("ik", models / "kiro3", "--pose", *home_pose("kiro3"), "--json")
    (solution,) = json.loads(result.stdout)["solutions"]
    assert [(joint["joint"], joint["unit"]) for joint in solution["q"]] == [
        ("theta_1", "deg"),
        ("theta_2", "deg"),
        ("d_3", "mm"),
        ("theta_4", "deg"),
    ]
    q, nominal, correction = (
        torch.tensor([joint["value"] for joint in solution[key]]) for key in ("q", "q_nominal", "correction")
    )
    assert_close(q - nominal, correction, atol=1e-3)


def test_table_fits_in_80_columns(run, models):
    result = run("ik", models / "kiro3", "--pose", *home_pose("kiro3"))
    assert result.exit_code == 0
    table = result.stdout.splitlines()[:-1]
    assert max(map(len, table)) <= 80
    assert table[0].startswith("reached, branch elbow_positive")
    for word in ("corrected", "nominal", "correction", "theta_2", "d_3", "mm", "deg"):
        assert word in result.stdout


def test_all_branches_of_a_pose(run, models):
    result = run("ik", models / "kiro4", "--pose", *home_pose("kiro4"), "--all-branches", "--json")
    assert result.exit_code == 0
    solutions = json.loads(result.stdout)["solutions"]
    assert [solution["branch"] for solution in solutions] == list(load(models / "kiro4").branches)
    assert "reached" in {solution["status"] for solution in solutions}
    one = run(
        "ik", models / "kiro4", "--pose", *home_pose("kiro4"), "--branch", solutions[1]["branch"], "--json"
    )
    assert json.loads(one.stdout)["solutions"] == [solutions[1]]


@pytest.mark.parametrize("name", HOMES)
def test_unreachable_pose(run, refuses, models, name):
    pose = (9000, 0, 0, 0, 0, 0)
    sentence = refuses("ik", models / name, "--pose", *pose, stdout=None)
    assert sentence.startswith("the pose 9000 0 0 0 0 0: unreachable. No joint values reach the pose")
    result = run("ik", models / name, "--pose", *pose, "--json")
    assert result.exit_code == 2
    (solution,) = json.loads(result.stdout)["solutions"]
    values = solution.get("q_deg") or [joint["value"] for joint in solution["q"]]
    assert solution["status"] == "unreachable"
    assert values == [None] * len(values)
    assert solution["domain_measure"] is None


@pytest.mark.parametrize(
    ("name", "q"), [("kiro3", [0.3, 0.0, -0.1, 0.0]), ("kiro4", [0.2, 0.5, 0.4, 0.3, 0.0, 0.2])]
)
def test_singular_pose(run, refuses, models, name, q):
    pose = pose_of(name, torch.tensor(q, dtype=torch.float64))
    assert ": singular. The joint values reach the pose, but it is singular" in refuses(
        "ik", models / name, "--pose", *pose, stdout=None
    )
    result = run("ik", models / name, "--pose", *pose, "--json")
    assert result.exit_code == 2
    (solution,) = json.loads(result.stdout)["solutions"]
    assert solution["status"] == "singular"
    assert None not in (solution.get("q_deg") or [joint["value"] for joint in solution["q"]])


def test_pose_outside_the_joint_limits(refuses, models):
    q = torch.tensor([0.3, 1.2, -0.44, 0.2], dtype=torch.float64)
    pose = pose_of("kiro3", q)
    pose[2] -= 50.0
    sentence = refuses("ik", models / "kiro3", "--pose", *pose, stdout=None)
    assert "outside_joint_limits" in sentence


def test_poses_of_a_file(run, models, tmp_path):
    rows = [pose_of("kiro4", q) for q in joints_around("kiro4", 5, seed=8, spread=0.1)]
    write_poses(tmp_path / "poses.csv", rows)
    out = tmp_path / "joints.csv"
    result = run("ik", models / "kiro4", "--poses", tmp_path / "poses.csv", "--out", out, "--json")
    assert result.exit_code == 0
    assert json.loads(result.stdout) == {"file": str(out), "rows": 5, "statuses": {"reached": 5}}
    written = list(csv.DictReader(out.read_text().splitlines()))
    T = forward_kinematics(Robot.load("kiro4"), joints_around("kiro4", 5, seed=8, spread=0.1))
    expected = load(models / "kiro4")(T)
    commanded = [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in written]
    nominal = [[float(row[f"q{i}_nominal_deg"]) for i in range(1, 7)] for row in written]
    assert_close(commanded, torch.rad2deg(expected.q), atol=1e-8)
    assert_close(nominal, torch.rad2deg(expected.q_nominal), atol=1e-8)
    assert {row["status"] for row in written} == {"reached"}
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["joints.csv", "poses.csv"]


def test_poses_that_fail_are_named_by_their_lines(run, models, tmp_path):
    good = home_pose("kiro3")
    singular = pose_of("kiro3", torch.tensor([0.3, 0.0, -0.1, 0.0], dtype=torch.float64))
    write_poses(tmp_path / "poses.csv", [good, [9000.0, 0.0, 0.0, 0.0, 0.0, 0.0], good, singular])
    out = tmp_path / "joints.csv"
    result = run("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", out)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"pisigma: {tmp_path}/poses.csv, line 3: unreachable.")
    assert result.stderr.endswith("(Also: line 5 singular.)\n")
    assert "2 reached, 1 unreachable, 1 singular" in result.stdout
    statuses = [row["status"] for row in csv.DictReader(out.read_text().splitlines())]
    assert statuses == ["reached", "unreachable", "reached", "singular"]
    assert list(csv.DictReader(out.read_text().splitlines()))[1]["q1_deg"] == ""


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--pose", 1, 2, 3],
        ["--pose", 1, 2, 3, 4, 5, "six"],
        ["--pose", 1, 2, 3, 4, 5, 6, "--poses", "poses.csv"],
        ["--poses", "poses.csv"],
        ["--pose", 1, 2, 3, 4, 5, 6, "--out", "joints.csv"],
        ["--poses", "poses.csv", "--out", "joints.csv", "--all-branches"],
        ["--pose", 1, 2, 3, 4, 5, 6, "--all-branches", "--branch", "flip"],
        ["--pose", 1, 2, 3, 4, 5, 6, "--colour", "red"],
    ],
)
def test_options_that_do_not_go_together(run, models, options):
    result = run("ik", models / "kiro3", *options)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr


def test_other_things_at_fault(refuses, models, tmp_path):
    pose = ("--pose", *home_pose("kiro3"))
    assert "there is no such model folder" in refuses("ik", tmp_path / "nothing", *pose)
    assert "model.yaml is missing" in refuses("ik", tmp_path, *pose)
    assert "did you mean 'elbow_positive'?" in refuses(
        "ik", models / "kiro3", *pose, "--branch", "elbow_positiv"
    )
    assert "finite numbers" in refuses("ik", models / "kiro3", "--pose", "nan", 0, 0, 0, 0, 0)
    out = ("--out", tmp_path / "joints.csv")
    assert "cannot be read" in refuses("ik", models / "kiro3", "--poses", tmp_path / "no.csv", *out)
    (tmp_path / "poses.csv").write_text("x_mm,y_mm\n1,2\n")
    assert "poses.csv, line 1: the column of 'z'" in refuses(
        "ik", models / "kiro3", "--poses", tmp_path / "poses.csv", *out
    )
    assert not (tmp_path / "joints.csv").exists()


def test_an_out_that_cannot_be_written(refuses, models, tmp_path):
    write_poses(tmp_path / "poses.csv", [home_pose("kiro3")])
    for out in (tmp_path, tmp_path / "nothing" / "joints.csv", tmp_path / "poses.csv" / "joints.csv"):
        sentence = refuses("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", out)
        assert sentence.startswith(f"{out}: cannot be written (")
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.csv"]
