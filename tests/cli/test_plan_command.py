"""`pisigma plan`: what it prints, writes and refuses."""

import json
from pathlib import Path

import pytest

SMALL = ("--count", "8", "--check", "2", "--candidates", "40")


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("plans")
    result = run("plan", "fanuc_r2000", *SMALL, "--out", folder / "poses.csv", "--json")
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    (folder / "printed.json").write_text(result.stdout)
    return folder


def test_json_has_the_figures_of_the_plan(folder):
    printed = json.loads((folder / "printed.json").read_text())
    assert printed["poses"] == 8
    assert printed["check_poses"] == 2
    assert printed["predicted_rms_mm"] == printed["curve"][-1]["rms_mm"]
    assert printed["predicted_p95_mm"] > printed["predicted_rms_mm"]
    assert {"poses", "rms_mm", "random_rms_mm"} <= set(printed["curve"][0])
    assert 0.5 < printed["minutes"] < 10
    assert printed["criterion"] == "I"
    assert printed["weak"]


def test_people_read_a_table_and_what_stays_uncertain(run, folder):
    result = run("plan", "fanuc_r2000", *SMALL, "--limit-mm", "0.001", "--out", folder / "again.csv")
    assert result.exit_code == 0
    assert max(map(len, result.stdout.splitlines())) <= 80
    for words in (
        "RMS [mm]",
        "needs more than 8 poses",
        "min at 30 deg/s",
        "again.plan.yaml",
        "mostly come from",
    ):
        assert words in " ".join(result.stdout.split())


def test_poses_of_a_file_keep_the_number_of_their_row(run, folder, tmp_path):
    arguments = ("--candidates-from", folder / "poses.csv", "--count", "3", "--check", "1")
    result = run("plan", "fanuc_r2000", *arguments, "--out", tmp_path / "some.csv")
    assert result.exit_code == 0, result.output
    _, *rows = (folder / "poses.csv").read_text().splitlines()
    _, *chosen = (tmp_path / "some.csv").read_text().splitlines()
    for line in chosen:
        cells = line.split(",")
        assert cells[:6] == rows[int(cells[8]) - 1].split(",")[:6]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--box", "1,2,3"), "--box: six numbers"),
        (("--criterion", "A"), "criterion 'A' is unknown"),
        (("--sensor", "distance"), "state it as the tracker of the cell"),
        (("--program", "poses.txt"), "a program goes into a .script or .src or .mod or .ls file"),
        (("--program", "class-1.src"), "takes names of letters"),
        (("--camera", "wrist.yaml"), "--board: "),
        (("--cell", "missing.yaml"), "missing.yaml: cannot be read"),
        (("--box", "5000,5000,5000,6000,6000,6000"), "10 poses were wanted, but 0 of"),
    ],
)
def test_what_cannot_be_is_refused(refuses, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert message in refuses("plan", "fanuc_r2000", *SMALL, *arguments, "--out", tmp_path / "poses.csv")
    assert not list(tmp_path.iterdir())


def test_options_of_cameras_are_refused_without_one(run, tmp_path):
    result = run("plan", "fanuc_r2000", *SMALL, "--sigma-px", "0.2", "--out", tmp_path / "poses.csv")
    assert result.exit_code == 2
    assert "--sigma-px: only with --camera and --board" in result.stderr
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_over_what_is_read(refuses, folder):
    poses = folder / "poses.csv"
    assert "is an input" in refuses("plan", "fanuc_r2000", *SMALL, "--candidates-from", poses, "--out", poses)


def test_models_that_do_not_say_how_uncertain_they_are_cannot_be_planned_for(refuses, models, tmp_path):
    message = refuses("plan", models / "kiro3", "--out", tmp_path / "poses.csv")
    assert "plan for its robot" in message
