"""Commands of a cell: what they print as JSON, and the exit status of what has to be done."""

import json

import pytest

from pisigma.files.errors import MeasurementError, ModelError, PlanningError


@pytest.fixture
def cell(run, tmp_path):
    folder = tmp_path / "cells" / "welder7"
    made = run("new", "ur10", "--out", folder, "--limit-mm", 0.3, "--json")
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["next"]["state"] == "no_plan"
    return folder


def test_status_names_the_next_command(run, cell):
    shown = run("status", cell)
    assert shown.exit_code == 0
    assert shown.stdout.splitlines()[-1].strip() == f"pisigma plan {cell}"
    assert run("status", cell, "--exit-code").exit_code == 3
    status = json.loads(run("status", cell, "--json").stdout)
    assert status["next"]["command"] == f"pisigma plan {cell}"
    assert (status["model"], status["limit_mm"], status["sessions"]) == (None, 0.3, [])


def test_status_of_a_folder_has_every_cell(run, cell):
    run("new", "rb5", "--out", cell.parent / "painter", "--json")
    found = json.loads(run("status", cell.parent, "--json").stdout)["cells"]
    assert [one["cell"] for one in found] == [str(cell.parent / "painter"), str(cell)]
    assert "painter" in run("status", cell.parent).stdout


def test_events_are_recorded(run, cell):
    recorded = run("event", cell, "mastering", "--date", "2026-01-10", "--note", "joint 3", "--json")
    assert json.loads(recorded.stdout) == {"day": "2026-01-10", "kind": "mastering", "note": "joint 3"}
    assert json.loads(run("status", cell, "--json").stdout)["events"] == [json.loads(recorded.stdout)]


def test_a_packed_cell_is_unpacked(run, cell, tmp_path):
    packed = json.loads(run("pack", cell, "--out", tmp_path / "cell.zip", "--json").stdout)
    assert packed["files"] == 1
    other = run("unpack", tmp_path / "cell.zip", "--out", tmp_path / "other", "--json")
    assert json.loads(other.stdout)["cell"] == str(tmp_path / "other")


def test_what_is_not_there_is_refused(refuses, cell, tmp_path):
    refuses("status", tmp_path / "nothing", error=PlanningError)
    refuses("use", cell, "a", error=ModelError, option="model", value="a")
    refuses(
        "session", cell, "a", "--set-aside", "wrong tool", error=MeasurementError, option="session", value="a"
    )
    refuses("event", cell, "earthquake", error=MeasurementError, option="event", value="earthquake")
    refuses("event", cell, "tool", "--date", "10.1.2026", error=MeasurementError, option="--date")
