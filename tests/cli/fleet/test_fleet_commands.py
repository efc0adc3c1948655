"""`pisigma fleet run` and `pisigma fleet status`."""

import json

import pytest
from testing.aged import model_before, rows_later
from testing.screens import assert_screen

from pisigma.files.errors import FleetError

pytest.importorskip("pyarrow", reason="Parquet comes with the extra fleet")


@pytest.fixture(scope="module")
def plant(tmp_path_factory, run):
    """A fleet of two robots, of which one was refused, worked out by a process."""
    folder = tmp_path_factory.mktemp("plant")
    for name in ("cell1", "cell2"):
        (folder / "in" / name).mkdir(parents=True)
    rows_later(30, 1).write_csv(folder / "in" / "cell1" / "2026-10-01.csv", model_before().robot)
    (folder / "in" / "cell2" / "2026-10-02.csv").write_text("<b>\n1\n", encoding="utf-8")
    options = ("--robot", "rb5", "--model", "geometric", "--jobs", "1", "--json")
    return folder, run("fleet", "run", folder / "in", "--out", folder / "out", *options)


def test_run_ends_with_3_where_a_robot_was_refused(plant):
    folder, done = plant
    assert done.exit_code == 3, done.output
    report = json.loads(done.stdout)
    assert (report["robots"], report["done"], report["resumed"]) == (2, 1, 0)
    assert report["results"] == str(folder / "out" / "results.parquet")
    assert [one["robot"] for one in report["refused"]] == ["cell2"]
    assert "line 1" in report["refused"][0]["reason"]


def test_status_prints_and_writes_a_page(plant, run):
    folder, _ = plant
    page = folder / "page.html"
    shown = run("fleet", "status", folder / "out", "--page", page, "--today", "2027-10-01")
    assert shown.exit_code == 3, shown.output
    assert_screen(shown.stdout, "overdue: cell1 (365 days)", "refused: cell2, 2026-10-02")
    text = page.read_text(encoding="utf-8")
    assert '<tr data-state="overdue">' in text
    assert "<b>" not in text
    assert "&lt;b&gt;" in text
    assert 'src="http' not in text


def test_what_is_not_a_fleet_is_refused(refuses, tmp_path):
    for arguments, fields in (
        (("status", tmp_path), {}),
        (("run", tmp_path, "--out", tmp_path / "out"), {}),
        (("run", tmp_path, "--out", tmp_path / "out", "--task", "calibrat"), {"value": "calibrat"}),
        (("run", tmp_path, "--out", tmp_path / "out", "--jobs", "0"), {"value": 0}),
    ):
        refuses("fleet", *arguments, error=FleetError, **fields)


def test_a_day_that_is_none_is_refused(plant, refuses):
    command = ("fleet", "status", plant[0] / "out", "--today", "today")
    refuses(*command, error=FleetError, option="--today", value="today")
