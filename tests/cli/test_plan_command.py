"""`pisigma plan`: what it prints, writes and refuses."""

import json
from pathlib import Path

import pytest
from testing.screens import assert_screen

from pisigma.files.errors import OutputError, PlanningError

SMALL = ("--count", "8", "--check", "2", "--set", "candidates=40")


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
    assert printed["main_error_sources"]


def test_the_terminal_shows_a_table_and_the_remaining_uncertainty(run, folder):
    result = run("plan", "fanuc_r2000", *SMALL, "--limit-mm", "0.001", "--out", folder / "again.csv")
    assert result.exit_code == 0
    assert_screen(
        result.stdout,
        "with 8 poses",
        "RMS [mm]",
        "30 deg/s",
        "again.plan.yaml",
        "0.001 mm",
        "of the variance",
    )


def test_poses_of_a_file_keep_the_number_of_their_row(run, folder, tmp_path):
    arguments = ("--set", f"candidates_from={folder / 'poses.csv'}", "--count", "3", "--check", "1")
    result = run("plan", "fanuc_r2000", *arguments, "--out", tmp_path / "some.csv")
    assert result.exit_code == 0, result.output
    _, *rows = (folder / "poses.csv").read_text().splitlines()
    _, *chosen = (tmp_path / "some.csv").read_text().splitlines()
    for line in chosen:
        cells = line.split(",")
        assert cells[:6] == rows[int(cells[8]) - 1].split(",")[:6]


@pytest.mark.parametrize(
    ("arguments", "fields"),
    [
        (("--set", "box=1,2,3"), {"option": "box", "value": "1,2,3"}),
        (("--set", "criterion=A"), {"option": "criterion", "value": "A"}),
        (("--sensor", "distance"), {"option": "--surroundings"}),
        (("--program", "poses.txt"), {}),
        (("--program", "class-1.src"), {}),
        (("--camera", "wrist.yaml"), {}),
        (("--surroundings", "missing.yaml"), {"file": "missing.yaml"}),
        (("--set", "box=5000,5000,5000,6000,6000,6000"), {"value": 0}),
    ],
)
def test_invalid_options_are_refused(refuses, tmp_path, monkeypatch, arguments, fields):
    monkeypatch.chdir(tmp_path)
    line = refuses("plan", "fanuc_r2000", *SMALL, *arguments, "--out", tmp_path / "poses.csv", **fields)
    assert fields or arguments[1].rpartition(".")[0] in line or arguments[0] in line
    assert not list(tmp_path.iterdir())


def test_options_of_cameras_are_refused_without_one(run, tmp_path):
    result = run("plan", "fanuc_r2000", *SMALL, "--set", "sigma_px=0.2", "--out", tmp_path / "poses.csv")
    assert result.exit_code == 2
    assert all(option in result.stderr for option in ("--set sigma_px", "--camera", "--board"))
    assert not list(tmp_path.iterdir())


def test_nothing_is_written_over_what_is_read(refuses, folder):
    poses = folder / "poses.csv"
    refuses(
        "plan",
        "fanuc_r2000",
        *SMALL,
        "--set",
        f"candidates_from={poses}",
        "--out",
        poses,
        error=OutputError,
        file="poses.csv",
    )


def test_models_without_uncertainty_cannot_be_planned_for(refuses, models, tmp_path):
    refuses("plan", models / "kiro3", "--out", tmp_path / "poses.csv", error=PlanningError)
