"""`pisigma monitor`."""

import json
import math
import sqlite3
from contextlib import closing

import pytest
from testing.aged import original_model, rows_after_change
from testing.screens import assert_screen

from pisigma.files.errors import OutputError
from pisigma.model.folder.model_folder import save_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a model and files of sessions, of which the last came after a collision."""
    folder = tmp_path_factory.mktemp("monitor")
    (folder / "model").mkdir()
    save_model(original_model(), folder / "model")
    for month in (1, 2, 3):
        moved = (0.0, 0.0, math.radians(0.25) * (month == 3), 0.0, 0.0, 0.0)
        rows_after_change(8, month, moved).write_csv(folder / f"2026-0{month}-01.csv", original_model().robot)
    return folder


def test_each_call_adds_a_session(run, folder):
    first = run("monitor", folder / "model", folder / "2026-01-01.csv", "--json")
    assert first.exit_code == 0, first.output
    second = run("monitor", folder / "model", folder / "2026-02-01.csv", "--json")
    report = json.loads(second.stdout)
    assert [one["file"] for one in report["sessions"]] == ["2026-02-01.csv"]
    assert [one["date"] for one in report["history"]] == ["2026-01-01", "2026-02-01"]
    again = run("monitor", folder / "model", folder / "2026-02-01.csv", "--json")
    assert len(json.loads(again.stdout)["history"]) == 2
    assert (folder / "model.history.sqlite").is_file()


def test_a_collision_is_reported_with_exit_status_3(run, folder):
    page = folder / "page.html"
    done = run(
        *("monitor", folder / "model", folder / "2026-03-01.csv", folder / "2026-01-01.csv"),
        *("--no-history", "--page", page, "--dates", "2026-05-01,2026-04-01", "--limit-mm", "0.2"),
    )
    assert done.exit_code == 3, done.output
    assert_screen(done.stdout, "2026-05-01: joint 3 moved by 0.2", "pisigma recalibrate rb5")
    text = page.read_text(encoding="utf-8")
    assert "joint 3 moved by 0.2" in text
    assert 'src="http' not in text


def test_a_page_has_to_be_html(refuses, folder):
    command = ("monitor", folder / "model", folder / "2026-01-01.csv", "--page", folder / "page.pdf")
    refuses(*command, error=OutputError, file="page.pdf", value=".pdf")


def test_a_year_mistyped_long_ago_is_named_left_out_and_corrected(run, folder):
    """Histories of earlier versions hold such days; a page is drawn all the same."""
    with closing(sqlite3.connect(folder / "model.history.sqlite")) as database, database:
        database.execute("UPDATE monitored_sessions SET day = '0206-01-01' WHERE file = '2026-01-01.csv'")
    arguments = (
        "monitor",
        folder / "model",
        folder / "2026-02-01.csv",
        "--page",
        folder / "page.html",
        "--json",
    )
    report = json.loads(run(*arguments).stdout)
    assert [one["date"] for one in report["history"]] == ["2026-02-01"]
    assert [one for one in report["warnings"] if "2026-01-01.csv" in one and "0206-01-01" in one]
    assert (folder / "page.html").is_file()
    refused = run("monitor", folder / "model", folder / "2026-01-01.csv", "--dates", "2206-01-01")
    assert refused.exit_code == 2
    run("monitor", folder / "model", folder / "2026-01-01.csv", "--json")
    report = json.loads(run(*arguments).stdout)
    assert [one["date"] for one in report["history"]] == ["2026-01-01", "2026-02-01"]
    assert not [one for one in report["warnings"] if "0206" in one]
