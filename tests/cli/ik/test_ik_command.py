"""`pisigma ik`: poses in, corrected joint values out, and what cannot be reached."""

import csv
import json
import subprocess
import sys

import pytest
import torch
from testing.closeness import assert_close
from testing.models import HOMES, joints_around
from testing.pose_files import COLUMNS, write_poses
from testing.screens import assert_screen

from pisigma.files.errors import MeasurementError, ModelError, OutputError, PoseError
from pisigma.model.inverse.loading import load
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform


def pose_of(name: str, q: torch.Tensor) -> list[float]:
    """X Y Z ROLL PITCH YAW [mm, deg] of joint values."""
    values = xyz_zyx_from_transform(forward_kinematics(Robot.load(name), q))
    return [*(values[:3] * 1e3).tolist(), *torch.rad2deg(values[3:]).tolist()]


def home_pose(name: str) -> list[float]:
    return pose_of(name, joints_around(name, seed=6, spread=0.1))


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
    assert_screen(result.stdout, "elbow_positive", "Trust: yes", heading="Solution")
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
    (single,) = json.loads(one.stdout)["solutions"]
    assert single.keys() == solutions[1].keys()
    for key, value in single.items():
        if isinstance(value, str):
            assert value == solutions[1][key]
        else:
            assert_close(value, solutions[1][key], atol=1e-12)  # batches of other sizes round otherwise


@pytest.mark.parametrize("name", HOMES)
def test_unreachable_pose(run, refuses, models, name):
    pose = (9000, 0, 0, 0, 0, 0)
    assert "9000 0 0 0 0 0: unreachable" in refuses("ik", models / name, "--pose", *pose, stdout=None)
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
    assert ": singular" in refuses("ik", models / name, "--pose", *pose, stdout=None)
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
    printed = {
        "file": str(out),
        "rows": 5,
        "statuses": {"reached": 5},
        "failed": 0,
        "first_failures": [],
        "warnings": [],
    }
    assert json.loads(result.stdout) == printed
    written = list(csv.DictReader(out.read_text().splitlines()))
    T = forward_kinematics(Robot.load("kiro4"), joints_around("kiro4", 5, seed=8, spread=0.1))
    expected = load(models / "kiro4")(T)
    commanded = [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in written]
    nominal = [[float(row[f"q{i}_nominal_deg"]) for i in range(1, 7)] for row in written]
    assert_close(commanded, torch.rad2deg(expected.q), atol=1e-8)
    assert_close(nominal, torch.rad2deg(expected.q_nominal), atol=1e-8)
    assert {row["status"] for row in written} == {"reached"}
    assert [row["line"] for row in written] == ["2", "3", "4", "5", "6"]
    assert max(float(row["position_residual_mm"]) for row in written) < 1e-6
    assert max(float(row["rotation_residual_deg"]) for row in written) < 1e-6
    assert all(float(row["domain_measure"]) >= 0 for row in written)
    assert "accuracy_mm" not in written[0]
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["joints.csv", "poses.csv"]


def test_poses_that_fail_are_named_by_their_lines(run, models, tmp_path):
    good = home_pose("kiro3")
    singular = pose_of("kiro3", torch.tensor([0.3, 0.0, -0.1, 0.0], dtype=torch.float64))
    write_poses(tmp_path / "poses.csv", [good, [9000.0, 0.0, 0.0, 0.0, 0.0, 0.0], good, singular])
    out = tmp_path / "joints.csv"
    result = run("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", out)
    assert result.exit_code == 2
    assert f"{tmp_path}/poses.csv, line 3: unreachable" in result.stderr
    assert "line 5 singular" in result.stderr
    assert "2 reached, 1 unreachable, 1 singular" in " ".join(result.stdout.split())
    statuses = [row["status"] for row in csv.DictReader(out.read_text().splitlines())]
    assert statuses == ["reached", "unreachable", "reached", "singular"]
    assert list(csv.DictReader(out.read_text().splitlines()))[1]["q1_deg"] == ""


BAD_ROWS = {
    4: ("1,2,three,4,5,6", "got 'three' (column 'z_mm')"),
    5: ("1,2,,4,5,6", "got '' (column 'z_mm')"),
    8: ("nan,2,3,4,5,6", "got 'nan' (column 'x_mm')"),
    9: ("1,2,3", "got 3"),
    11: ('1,2,3,4,5,"6', "CSV"),
    14: ("400000,100000,200000,0,0,0", "458.3 m"),
}
"""By line of the file: a row that is no pose, and why."""


@pytest.fixture
def one_row_at_fault(tmp_path):
    """A file of poses of kiro4 in which the rows `BAD_ROWS` stand between good ones, and the good ones."""
    good = [pose_of("kiro4", q) for q in joints_around("kiro4", 12, seed=8, spread=0.1)]
    lines = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in good)]
    for line, (row, _) in BAD_ROWS.items():
        lines.insert(line - 1, row)
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n")
    return path, good


@pytest.mark.parametrize("rows_at_a_time", [1, 4, 1000])
def test_rows_that_are_no_poses_do_not_stop_the_others(
    run, models, tmp_path, monkeypatch, one_row_at_fault, rows_at_a_time
):
    path, good = one_row_at_fault
    monkeypatch.setattr("pisigma.cli.ik.joint_file.CHUNK_ROWS", rows_at_a_time)
    out = tmp_path / "joints.csv"
    result = run("ik", models / "kiro4", "--poses", path, "--out", out, "--json")
    assert result.exit_code == 2
    printed = json.loads(result.stdout)
    assert printed["rows"] == len(good) + len(BAD_ROWS)
    assert printed["statuses"] == {"reached": len(good), "bad_row": len(BAD_ROWS)}
    assert [row["line"] for row in printed["first_failures"]] == list(BAD_ROWS)
    for row, (_, reason) in zip(printed["first_failures"], BAD_ROWS.values(), strict=True):
        assert row["status"] == "bad_row"
        assert reason in row["reason"]
        assert reason in result.stderr
    assert f"{path}, line 4: bad_row" in result.stderr
    written = list(csv.DictReader(out.read_text().splitlines()))
    assert [int(row["line"]) for row in written] == list(range(2, 2 + len(good) + len(BAD_ROWS)))
    solved = [row for row in written if row["status"] != "bad_row"]
    expected = load(models / "kiro4")(
        forward_kinematics(Robot.load("kiro4"), joints_around("kiro4", 12, seed=8, spread=0.1))
    )
    commanded = [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in solved]
    assert_close(commanded, torch.rad2deg(expected.q), atol=1e-7)
    for line, row in enumerate(written, start=2):
        empty = {key for key, value in row.items() if value == ""}
        assert empty == (set(row) - {"line", "status"} if line in BAD_ROWS else set())


def test_only_the_first_failures_are_listed_separately(run, models, tmp_path):
    path, out = tmp_path / "poses.csv", tmp_path / "joints.csv"
    path.write_text("\n".join([",".join(COLUMNS), *["x,0,0,0,0,0"] * 25]) + "\n")
    result = run("ik", models / "kiro4", "--poses", path, "--out", out, "--json")
    assert result.exit_code == 2
    printed = json.loads(result.stdout)
    assert (printed["failed"], len(printed["first_failures"])) == (25, 10)
    assert "15 more" in result.stderr
    assert len(out.read_text().splitlines()) == 26


def test_metres_are_not_refused(run, models, tmp_path):
    q = joints_around("kiro4", 3, seed=8, spread=0.1)
    poses = torch.tensor([pose_of("kiro4", row) for row in q])
    lines = [[*(row[:3] / 1e3).tolist(), *row[3:].tolist()] for row in poses]
    header = ",".join(COLUMNS).replace("_mm", "_m")
    path, out = tmp_path / "poses.csv", tmp_path / "joints.csv"
    path.write_text("\n".join([header, *(",".join(map(repr, row)) for row in lines)]))
    assert run("ik", models / "kiro4", "--poses", path, "--out", out).exit_code == 0
    thousandfold = [[*row[:3].tolist(), *row[3:].tolist()] for row in poses]
    path.write_text("\n".join([header, *(",".join(map(repr, row)) for row in thousandfold)]))
    result = run("ik", models / "kiro4", "--poses", path, "--out", out)
    assert result.exit_code == 2
    assert "line 2: bad_row" in result.stderr


def test_an_interruption_leaves_nothing(run, models, tmp_path, monkeypatch):
    write_poses(tmp_path / "poses.csv", [home_pose("kiro3")] * 5)
    out, chunks = tmp_path / "joints.csv", []
    monkeypatch.setattr("pisigma.cli.ik.joint_file.CHUNK_ROWS", 2)

    def interrupted(solver, T, branch, path):
        chunks.append(len(T))
        if len(chunks) == 2:
            assert len(list(tmp_path.iterdir())) == 2  # the poses, and what was written so far
            raise KeyboardInterrupt
        return solver(T, branch=branch), ()

    monkeypatch.setattr("pisigma.cli.ik.joint_file._solve", interrupted)
    result = run("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", out)
    assert result.exit_code == 130
    assert chunks == [2, 2]
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.csv"]


def test_the_file_of_poses_is_not_overwritten(refuses, models, tmp_path):
    write_poses(tmp_path / "poses.csv", [home_pose("kiro3")])
    before = (tmp_path / "poses.csv").read_text()
    same = tmp_path / "poses.csv"
    refuses("ik", models / "kiro3", "--poses", same, "--out", same, error=OutputError, file="poses.csv")
    assert same.read_text() == before


def test_accuracy_is_computed_if_requested(run, models, tmp_path):
    write_poses(tmp_path / "poses.csv", [home_pose("kiro3")])
    out = tmp_path / "joints.csv"
    run("ik", models / "kiro3", "--poses", tmp_path / "poses.csv", "--out", out, "--accuracy")
    (row,) = csv.DictReader(out.read_text().splitlines())
    assert row["accuracy_mm"] == ""  # a model of joint errors knows none
    assert row["status"] == "reached"


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
        ["--pose", 1, 2, 3, 4, 5, 6, "--accuracy"],
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
    refuses("ik", tmp_path / "nothing", *pose, error=ModelError)
    refuses("ik", tmp_path, *pose, error=ModelError)
    refuses("ik", models / "kiro3", *pose, "--branch", "elbow_positiv", error=PoseError)
    refuses("ik", models / "kiro3", "--pose", "nan", 0, 0, 0, 0, 0, error=PoseError, option="--pose")
    refuses("ik", models / "kiro3", "--pose", 300, 250, 300, 0, "inf", 0, error=PoseError, option="--pose")
    refuses(
        "ik",
        models / "kiro3",
        "--pose",
        300,
        250,
        300,
        1e300,
        0,
        0,
        error=PoseError,
        option="--pose",
        value=1e300,
    )
    out = ("--out", tmp_path / "joints.csv")
    refuses(
        "ik", models / "kiro3", "--poses", tmp_path / "no.csv", *out, error=MeasurementError, file="no.csv"
    )
    (tmp_path / "poses.csv").write_text("x_mm,y_mm\n1,2\n")
    refuses(
        "ik",
        models / "kiro3",
        "--poses",
        tmp_path / "poses.csv",
        *out,
        error=MeasurementError,
        file="poses.csv",
        line=1,
        value="z",
    )
    assert not (tmp_path / "joints.csv").exists()


def test_an_out_that_cannot_be_written(refuses, models, tmp_path):
    write_poses(tmp_path / "poses.csv", [home_pose("kiro3")])
    for out in (tmp_path, tmp_path / "nothing" / "joints.csv", tmp_path / "poses.csv" / "joints.csv"):
        refuses(
            "ik",
            models / "kiro3",
            "--poses",
            tmp_path / "poses.csv",
            "--out",
            out,
            error=OutputError,
            file=out,
        )
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.csv"]


def test_a_pose_needs_no_torch(models):
    """One pose from a shell, which somebody waits for."""
    pose = [str(value) for value in home_pose("kiro4")]
    script = (
        "import sys\nsys.modules['torch'] = sys.modules['numba'] = None  # importing them fails\n"
        "from pisigma.cli.main import app\napp()\n"
    )
    for more in ([], ["--all-branches"], ["--json"]):
        command = [sys.executable, "-c", script, "ik", str(models / "kiro4"), "--pose", *pose, *more]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0 or more == ["--all-branches"], done.stderr
        assert ("reached" if more else "Trust: yes") in done.stdout
