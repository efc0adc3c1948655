"""`pisigma export --format targets`: poses in, a table or a program out."""

import csv
import json

import pytest
import torch
from testing.closeness import assert_close
from testing.identified import hybrid_model
from testing.models import joints_around
from testing.program_readers import READERS

from pisigma.files.errors import MeasurementError, ModelError, OutputError, PoseError, UnreachablePoseError
from pisigma.joint_correction.conditions import ConditionFeatures
from pisigma.joint_correction.fourier_series import FourierSeries
from pisigma.measurement.dataset import Measurements
from pisigma.model.calibrated_model import poses_of_rows
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.robot import Robot
from pisigma.robot.kinematics.forward import forward_kinematics
from pisigma.robot.se3 import xyz_zyx_from_transform

COLUMNS = ("x_mm", "y_mm", "z_mm", "roll_deg", "pitch_deg", "yaw_deg")
FAR = (9000.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def poses_of(name: str, q: torch.Tensor) -> list[tuple[float, ...]]:
    values = xyz_zyx_from_transform(forward_kinematics(Robot.load(name), q))
    return [tuple(row) for row in torch.cat([values[:, :3] * 1e3, torch.rad2deg(values[:, 3:])], -1).tolist()]


def good_poses(name: str, rows: int = 3) -> list[tuple[float, ...]]:
    return poses_of(name, joints_around(name, rows, seed=6, spread=0.1))


@pytest.fixture
def poses(tmp_path):
    """Write a file of poses; line 2 is a comment, so the first pose is in line 3."""

    def write(rows):
        path = tmp_path / "poses.csv"
        lines = [",".join(COLUMNS), "# by hand", *(",".join(map(repr, row)) for row in rows)]
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


def export(run, model, poses, out, *options):
    return run("export", model, "--format", "targets", "--poses", poses, "--out", out, *options)


def test_targets_for_a_payload(run, refuses, poses, tmp_path):
    robot = Robot.load("ur10")
    learned = ConditionFeatures(robot, ("payload_kg",), (2.0,), (1.5,), ((0.0, 5.0),))
    (tmp_path / "arm").mkdir()
    save_model(hybrid_model("ur10", [FourierSeries(robot, 2), learned]), tmp_path / "arm")
    path, out = poses(good_poses("ur10")), tmp_path / "targets.csv"
    assert export(run, tmp_path / "arm", path, out).exit_code == 0
    assert "For payload_kg 2 (mean of the calibration)." in out.read_text()
    assert export(run, tmp_path / "arm", path, out, "--payload-kg", 5).exit_code == 0
    assert "For payload_kg 5." in out.read_text()
    rows = list(csv.DictReader(line for line in out.read_text().splitlines() if not line.startswith("#")))
    degrees = [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows]
    q = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    wanted = forward_kinematics(robot, joints_around("ur10", 3, seed=6, spread=0.1))
    payload = torch.full((3,), 5.0, dtype=torch.float64)
    assert_close(
        poses_of_rows(load_model(tmp_path / "arm"), Measurements(q=q, payload=payload)), wanted, atol=1e-9
    )
    beyond = "payload_kg 9 "
    assert export(run, tmp_path / "arm", path, out, "--payload-kg", 9).exit_code == 0
    assert beyond in out.read_text()
    written = run(
        "ik", tmp_path / "arm", "--poses", path, "--out", tmp_path / "q.csv", "--payload-kg", 9, "--json"
    )
    assert json.loads(written.stdout)["warnings"][0].startswith(beyond)
    pose = run("ik", tmp_path / "arm", "--pose", *[500, 200, 300, 0, 0, 0], "--payload-kg", 9)
    assert f"Warning: {beyond}" in pose.stdout
    found = run("ik", tmp_path / "arm", "--poses", path, "--out", tmp_path / "q.csv", "--payload-kg", 5)
    assert found.exit_code == 0
    joints = list(csv.DictReader((tmp_path / "q.csv").read_text().splitlines()))
    assert [float(row["q1_deg"]) for row in joints] == pytest.approx([float(row["q1_deg"]) for row in rows])
    options = ("--format", "offsets", "--out", tmp_path / "offsets.csv", "--payload-kg")
    assert run("export", tmp_path / "arm", *options, 5).exit_code == 0
    assert "For payload_kg 5." in (tmp_path / "offsets.csv").read_text()
    refuses("export", tmp_path / "arm", *options, -1, error=ModelError)
    table = ("--format", "dh", "--out", tmp_path / "dh.csv", "--payload-kg", 5)
    refuses("export", tmp_path / "arm", *table)


def test_a_table(run, models, poses, tmp_path):
    path, out = poses(good_poses("ur10")), tmp_path / "targets.csv"
    result = export(run, models / "ur10", path, out)
    assert (result.exit_code, result.stderr) == (0, "")
    assert all(word in result.stdout for word in ("3 poses", str(out), "3 reached"))
    rows = list(csv.DictReader(line for line in out.read_text().splitlines() if not line.startswith("#")))
    assert [row["line"] for row in rows] == ["3", "4", "5"]
    degrees = [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows]
    q = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    reached = load_model(models / "ur10").forward(q)
    wanted = forward_kinematics(Robot.load("ur10"), joints_around("ur10", 3, seed=6, spread=0.1))
    assert_close(reached, wanted, atol=1e-9)
    told = json.loads(export(run, models / "ur10", path, out, "--json").stdout)
    assert told == {
        "file": str(out),
        "format": "targets",
        "targets": "both",
        "robot": "ur10",
        "rows": 3,
        "statuses": {"reached": 3},
        "remarks": [],
    }


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("kind", [None, "joints", "cartesian"])
def test_a_program(run, models, poses, tmp_path, suffix, kind):
    path, out, table = poses(good_poses("ur10")), tmp_path / f"cell{suffix}", tmp_path / "targets.csv"
    assert export(run, models / "ur10", path, table).exit_code == 0
    options = [] if kind is None else ["--targets", kind]
    options += ["--config", "N U T, 0, 0, 0"] if (kind, suffix) == ("cartesian", ".ls") else []
    result = export(run, models / "ur10", path, out, *options, "--json")
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert (told["targets"], told["rows"]) == (kind or "joints", 3)
    assert "".join(f"pisigma: {remark}\n" for remark in told["remarks"]) == result.stderr
    assert any("J3" in remark for remark in told["remarks"]) == (suffix == ".ls")
    program = READERS[suffix](out.read_bytes().decode("ascii"))
    assert [remark for remark in program.remarks if remark.startswith("line ")] == [
        "line 3",
        "line 4",
        "line 5",
    ]
    rows = list(csv.DictReader(line for line in table.read_text().splitlines() if not line.startswith("#")))
    if kind == "cartesian":
        factor = 1e3 if suffix == ".script" else 1.0
        found = [[factor * value for value in pose[:3]] for pose in program.poses]
        assert_close(found, [[float(row[name]) for name in COLUMNS[:3]] for row in rows], atol=1.1e-6)
    else:
        q = torch.tensor(program.joints, dtype=torch.float64)
        found = torch.rad2deg(q) if suffix == ".script" else q
        assert_close(found, [[float(row[f"q{i}_deg"]) for i in range(1, 7)] for row in rows], atol=1.1e-6)


def test_a_table_of_a_robot_with_a_sliding_joint(run, models, poses, tmp_path):
    out = tmp_path / "targets.csv"
    assert export(run, models / "kiro3", poses(good_poses("kiro3")), out).exit_code == 0
    assert "line,status,branch,q1_deg,q2_deg,q3_mm,q4_deg,x_mm," in out.read_text()


def test_the_requested_branch_is_used(run, models, poses, tmp_path):
    path, out = poses(good_poses("kiro4", 1)), tmp_path / "targets.csv"
    every = json.loads(
        run("ik", models / "kiro4", "--pose", *good_poses("kiro4", 1)[0], "--all-branches", "--json").stdout
    )
    found = next(s for s in every["solutions"][1:] if s["status"] in ("reached", "outside_domain"))
    assert export(run, models / "kiro4", path, out, "--branch", found["branch"]).exit_code == 0
    (row,) = csv.DictReader(line for line in out.read_text().splitlines() if not line.startswith("#"))
    assert row["branch"] == found["branch"]
    assert_close([float(row[f"q{i}_deg"]) for i in range(1, 7)], found["q_deg"], atol=1e-6)


def test_a_pose_that_cannot_be_reached(run, refuses, models, poses, tmp_path):
    good = good_poses("ur10", 2)
    path, table, program = poses([good[0], FAR, good[1]]), tmp_path / "t.csv", tmp_path / "t.src"
    result = export(run, models / "ur10", path, table)
    assert result.exit_code == 2
    assert "2 reached, 1 unreachable" in " ".join(result.stdout.split())
    assert f"{path}, line 4: unreachable" in result.stderr
    rows = list(csv.DictReader(line for line in table.read_text().splitlines() if not line.startswith("#")))
    assert [row["status"] for row in rows] == ["reached", "unreachable", "reached"]
    assert {rows[1][name] for name in ("q1_deg", "q6_deg", "x_mm", "yaw_deg", "sigma_mm")} == {""}
    program.write_text("old")
    command = ("export", models / "ur10", "--format", "targets", "--poses", path, "--out", program, "--json")
    assert "line 4: unreachable" in refuses(*command, stdout=None, error=UnreachablePoseError)
    assert program.read_text() == "old"


def test_a_singular_pose(run, models, poses, tmp_path):
    q = torch.tensor([[0.3, 0.0, -0.1, 0.0]], dtype=torch.float64)
    out = tmp_path / "targets.csv"
    result = export(run, models / "kiro3", poses(poses_of("kiro3", q)), out)
    assert result.exit_code == 2
    assert "line 3: singular" in result.stderr
    assert "\n3,singular,elbow_positive,,,,,,,,,,,\n" in out.read_text()


def test_a_pose_outside_the_domain(run, models, poses, tmp_path):
    far = joints_around("ur10", 1, seed=6, spread=0.1) + torch.tensor([1.5, 0, 0, 0, 0, 0])
    path = poses([*good_poses("ur10", 1), *poses_of("ur10", far)])
    for suffix in (".csv", *READERS):
        out = tmp_path / f"cell{suffix}"
        result = export(run, models / "ur10", path, out)
        assert result.exit_code == 0
        assert "1 reached, 1 outside_domain" in " ".join(result.stdout.split())
        assert "line 4: outside_domain" in result.stderr
        text = out.read_text()
        assert ("4,outside_domain," if suffix == ".csv" else "line 4 OUTSIDE DOMAIN") in text


CARTESIAN = ("--poses", "poses.csv", "--targets", "cartesian")


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        (("--out", "cell.csv"), OutputError, ("targets", "--poses", "--program")),
        (("--out", "cell.txt", "--poses", "poses.csv"), OutputError, ("cell.txt", ".csv", ".script")),
        (("--out", "cell.src", "--poses", "none.csv"), MeasurementError, ("none.csv",)),
        (("--out", "poses.csv", "--poses", "poses.csv"), OutputError, ("poses.csv", "input")),
        (("--out", "9 bad-name.ls", "--poses", "poses.csv"), OutputError, ("9 bad-name.ls", "FANUC")),
        (
            ("--out", "cell.src", "--poses", "poses.csv", "--targets", "joint"),
            OutputError,
            ("--targets", "'joint'", "'joints'"),
        ),
        (
            ("--out", "cell.csv", "--poses", "poses.csv", "--targets", "joints"),
            OutputError,
            ("--targets", ".csv"),
        ),
        (("--out", "cell.ls", *CARTESIAN), OutputError, ("cell.ls", "--config", "N U T")),
        (("--out", "cell.mod", *CARTESIAN, "--config", "N U T, 0, 0, 0"), OutputError, ("--config", ".ls")),
        (
            ("--out", "cell.mod", "--poses", "poses.csv", "--branch", "up"),
            PoseError,
            ("'up'", "back/elbow_down/flip"),
        ),
    ],
)
def test_what_is_refused(refuses, models, poses, tmp_path, monkeypatch, options, error, words):
    monkeypatch.chdir(tmp_path)
    poses(good_poses("ur10"))
    message = refuses("export", models / "ur10", "--format", "targets", *options, error=error)
    assert all(word in message for word in words), message
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.csv"]


@pytest.mark.parametrize("option", ["--poses", "--targets", "--branch", "--config"])
def test_options_of_targets_go_with_targets(refuses, models, tmp_path, option):
    command = ("export", models / "ur10", "--format", "urdf", "--out", tmp_path / "robot.urdf", option, "x")
    message = refuses(*command, error=OutputError)
    assert all(word in message for word in (option, "targets", "urdf"))


def test_a_sliding_joint_has_no_program(refuses, models, poses, tmp_path):
    path = poses(good_poses("kiro3"))
    command = ("export", models / "kiro3", "--format", "targets", "--poses", path)
    message = refuses(*command, "--out", tmp_path / "cell.script", error=OutputError)
    assert all(word in message for word in ("URScript", "'kiro3'"))
    assert not (tmp_path / "cell.script").exists()


def test_the_command_tells_its_formats(run):
    text = run("export", "--help-all").stdout
    assert all(word in text for word in ("targets", "--poses", "--config", "URScript", "FANUC", "cartesian"))


def test_a_program_is_rewritten(run, refuses, models, tmp_path):
    values = xyz_zyx_from_transform(
        forward_kinematics(Robot.load("ur10"), joints_around("ur10", 1, seed=6, spread=0.1))
    )
    letters = [f"{letter} {value}" for letter, value in zip("XYZABC", torch.cat(
        [values[0, :3] * 1e3, torch.rad2deg(values[0, 3:])]).tolist(), strict=True)]  # fmt: skip
    move = f"LIN {{{', '.join(letters)}}}"
    program, out = tmp_path / "cell.src", tmp_path / "new.src"
    program.write_text(
        f"DEF cell()\n$BASE = $NULLFRAME\n$TOOL = $NULLFRAME\n{move}\nLIN {{X 9000, Y 0, Z 0, A 0, B 0, C 0}}\n"
    )
    command = ("export", models / "ur10", "--format", "targets", "--program", program, "--out", out)
    result = run(*command)
    assert result.exit_code == 3
    assert f"-{move}\n+LIN {{X " in result.stdout
    assert "cell.src, line 5: unreachable" in result.stderr
    assert "line 4: " in result.stderr
    stated = json.loads(run(*command, "--json").stdout)
    assert (stated["statuses"], stated["way_points"]) == ({"reached": 1, "unreachable": 1}, 0)
    assert stated["diff"].splitlines()[0] == f"--- {program}"
    assert run(*command[:-1], program).exit_code == 2
    dh = ("export", models / "ur10", "--format", "dh", "--program", program, "--out", tmp_path / "dh.csv")
    assert "--program" in refuses(*dh, error=OutputError)
