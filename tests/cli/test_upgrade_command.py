"""`pisigma upgrade`."""

import json

import pytest
from testing.cell_before import cell_of_schema_1

from pisigma.lifetime.cell.history import HISTORY, SCHEMA_VERSION, History
from pisigma.model.folder.model_document import FORMAT


def test_a_folder_of_the_current_version_is_reported(run, models):
    result = run("upgrade", models / "kiro3", "--json")
    assert json.loads(result.stdout) == {
        "model": str(models / "kiro3"),
        "name": "hand_made_kiro3",
        "before": FORMAT,
        "after": FORMAT,
        "changes": [],
    }
    assert f"({FORMAT})" in run("upgrade", models / "kiro3").stdout


def test_a_folder_without_a_model_is_refused(refuses, tmp_path):
    refuses("upgrade", tmp_path)
    refuses("upgrade", "/")


@pytest.fixture
def older(tmp_path):
    """A cell of schema version 1."""
    return cell_of_schema_1(tmp_path)


def test_a_cell_of_an_earlier_version_is_upgraded_with_its_models(run, older):
    done = json.loads(run("upgrade", older, "--json").stdout)
    assert (done["before"], done["after"]) == (1, SCHEMA_VERSION)
    assert [one["name"] for one in done["models"]] == ["2026-11-26"]
    again = json.loads(run("upgrade", older, "--json").stdout)
    assert (again["before"], again["after"]) == (SCHEMA_VERSION, SCHEMA_VERSION)
    assert json.loads(run("status", older, "--json").stdout)["model"] == "2026-11-26"


def test_the_history_follows_a_model_whose_folder_was_upgraded(older):
    history = History(older / HISTORY)
    history.replace_model_hash(history.models()[0].sha256, "new")
    assert history.models()[0].sha256 == "new"
    assert {one.model_sha256 for one in history.monitored_sessions()} == {"new"}
