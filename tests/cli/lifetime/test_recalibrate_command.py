"""`pisigma recalibrate`."""

import json
import shlex

import pytest
from gate.table import moved, positions
from testing.aged import original_model, rows_after_change
from testing.refusals import assert_fields, problem_of
from testing.screens import assert_screen

from pisigma.model.folder.model_folder import save_model
from pisigma.workflow.recalibrate import recalibrate
from pisigma.workflow.settings.recalibration import RecalibrationSettings


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a model and a file of new rows."""
    folder = tmp_path_factory.mktemp("recalibrate")
    (folder / "model").mkdir()
    save_model(original_model(), folder / "model")
    rows_after_change(10, 2, (0.0, 0.0, 0.00436, 0.0, 0.0, 0.0)).write_csv(
        folder / "rows.csv", original_model().robot
    )
    return folder


def test_the_model_is_written_and_described(run, folder):
    done = run("recalibrate", folder / "model", folder / "rows.csv", "--out", folder / "new", "--json")
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert (report["kept"], report["model"]) == ("recalibrated", str(folder / "new"))
    assert [one["what"] for one in report["moved"]] == ["joint 3"]
    assert "pisigma recalibrate model rows.csv --out new" in (folder / "new" / "README.md").read_text()
    assert run("verify", folder / "new", folder / "rows.csv").exit_code in (0, 3)


def test_a_dry_run_writes_nothing(run, folder):
    before = sorted(folder.iterdir())
    done = run("recalibrate", folder / "model", folder / "rows.csv", "--dry-run", "--moved", "")
    assert done.exit_code == 0, done.output
    assert_screen(
        done.stdout, "joint 3 moved by 0.2", "recalibrated 0.", "held out in cross-validation of 10"
    )
    assert sorted(folder.iterdir()) == before


@pytest.fixture(scope="module")
def other_rows(folder):
    """Files of rows with what is wrong, or moved, in them."""
    for name, change in {"tracker": moved((6.0, 0.0, 0.0)), "inches": positions(1 / 25.4)}.items():
        change(rows_after_change(10, 2)).write_csv(folder / f"{name}.csv", original_model().robot)
    return folder


@pytest.mark.parametrize(
    ("rows", "stated", "status"),
    [("tracker", "base", 0), ("tracker", "", 3), ("inches", "base,tool", 3)],
)
def test_a_dry_run_ends_as_the_run(run, other_rows, tmp_path, monkeypatch, rows, stated, status):
    results = []

    def once(*arguments):
        results.append(results[0] if results else recalibrate(*arguments))
        return results[-1]

    monkeypatch.setattr("pisigma.workflow.recalibrate.recalibrate", once)
    words = ("recalibrate", other_rows / "model", other_rows / f"{rows}.csv", "--moved", stated)
    dry, done = run(*words, "--dry-run"), run(*words, "--out", tmp_path / "new")
    assert (dry.exit_code, done.exit_code, len(results)) == (status, status, 2), dry.output
    assert (tmp_path / "new").exists() == (status == 0)


def test_moved_parts_are_written_into_commands():
    stated = {None: [], (): ["--moved", ""], ("base", "tool"): ["--moved", "base,tool"]}
    for moved_parts, words in stated.items():
        line = RecalibrationSettings(moved_parts).command("model", "rows.csv")
        assert shlex.split(line) == ["pisigma", "recalibrate", "model", "rows.csv", *words, "--out", "DIR"]


def test_either_a_folder_or_a_dry_run_is_required(run, folder):
    done = run("recalibrate", folder / "model", folder / "rows.csv")
    assert done.exit_code == 2
    assert "--dry-run" in done.stderr
    other = run("recalibrate", folder / "model", folder / "rows.csv", "--dry-run", "--moved", "arm")
    assert other.exit_code == 2
    assert_fields(problem_of(other), value="arm")
