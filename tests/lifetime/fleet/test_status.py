"""Status of a fleet: cells by their states, and the largest errors."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.lifetime.cell.history import HISTORY, Check, History, InUse, ModelEntry, SessionEntry
from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.reporting.fleet_tables import cell_table, fleet_verdict, state_table

SESSION = SessionEntry("2026-03-01", "hash", "2026-03-02T09:00:00+00:00", "2026-03-01", 30, "position")
DESCRIPTION = b"format: 5\n"
MODEL = ModelEntry(
    "a", hashlib.sha256(DESCRIPTION).hexdigest(), "2026-03-02T12:00:00+00:00", "2026-03-01", "2026-03-01"
)
CHECK = Check("calibrate", "a", "", "trusted", "", None, False, "2026-03-02T12:00:00+00:00", 0.05)


def cell(folder, name, *entries, text="robot: ur10\n"):
    path = folder / name
    (path / "sessions").mkdir(parents=True)
    (path / "cell.yaml").write_text(text)
    (path / "sessions" / "2026-03-01.csv").write_text("rows")
    if entries:
        History(path / HISTORY).add(*entries)
        (path / "models" / "a").mkdir(parents=True)
        (path / "models" / "a" / "model.yaml").write_bytes(DESCRIPTION)
        (path / "models" / "a" / "model.safetensors").write_bytes(b"")
    return path


@pytest.fixture
def fleet(tmp_path):
    """One cell in each of six states."""
    session = replace(SESSION, sha256=hashlib.sha256(b"rows").hexdigest())
    cell(tmp_path, "new")
    cell(tmp_path, "measured", session, MODEL, replace(CHECK, rms_mm=0.2))
    cell(tmp_path, "edited", replace(session, sha256="other"), MODEL, CHECK)
    moved = Check("verify", "a", "x", "moved", "joint 3 moved", 0.9, True, "2026-04-01T00:00:00+00:00", 0.8)
    used = InUse("a", "2026-03-03T00:00:00+00:00", "")
    aside = replace(SESSION, name="2026-05-01", day="2026-05-01", set_aside="wrong reflector")
    cell(tmp_path, "moved", session, aside, MODEL, CHECK, moved, used)
    cell(tmp_path, "broken", text="robot: [\n")
    cell(tmp_path, "negative", text="robot: ur10\nlimit_mm: -1\n")
    return FleetStatus.read(tmp_path)


def test_cells_are_grouped_by_state_the_most_urgent_first(fleet):
    assert fleet.states == {
        "unreadable": ("broken", "negative"),
        "edited_session": ("edited",),
        "moved": ("moved",),
        "not_taken_in": ("new",),
        "not_verified": ("measured",),
    }
    assert fleet.needs_action
    assert dict(state_table(fleet).rows)["unreadable"] == "2"


def test_the_last_error_of_each_model_is_used(fleet):
    assert [(one.name, check.rms_mm) for one, check in fleet.sorted_by_error] == [
        ("moved", 0.8),
        ("measured", 0.2),
        ("edited", 0.05),
    ]
    assert cell_table(fleet.cells).rows[2] == ("moved", "a", "2026-03-01", "0.800", "verify", "moved")
    assert "moved" in fleet_verdict(fleet).accuracy


def test_all_figures_are_json(fleet):
    printed = fleet.to_json()
    assert [one["cell"] for one in printed["unreadable"]] == ["broken", "negative"]
    assert printed["largest_errors"][0] == {"cell": "moved", "rms_mm": 0.8, "command": "verify"}
    assert [Path(one["cell"]).name for one in printed["cells"]] == ["edited", "measured", "moved", "new"]


def test_a_measured_fleet_needs_no_action(tmp_path, fleet):
    for name in ("new", "edited", "moved", "broken", "negative"):
        (tmp_path / name / "cell.yaml").unlink()
    seen = FleetStatus.read(tmp_path)
    assert not seen.needs_action
    assert fleet_verdict(seen).trust.startswith("yes")
    (tmp_path / "measured" / "cell.yaml").unlink()
    with refused(PlanningError, value=str(tmp_path)):
        FleetStatus.read(tmp_path)
