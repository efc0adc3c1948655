"""`pisigma recalibrate`."""

import json

import pytest
from testing.aged import model_before, rows_later

from pisigma.model.folder.model_folder import save_model


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a model and a file of new rows."""
    folder = tmp_path_factory.mktemp("recalibrate")
    (folder / "model").mkdir()
    save_model(model_before(), folder / "model")
    rows_later(10, 2, (0.0, 0.0, 0.00436, 0.0, 0.0, 0.0)).write_csv(folder / "rows.csv", model_before().robot)
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
    assert "Joint 3 moved by 0.2" in done.stdout
    assert "The recalibrated model is kept" in done.stdout
    assert "Model written" not in done.stdout
    assert sorted(folder.iterdir()) == before


def test_either_a_folder_or_a_dry_run_is_wanted(run, folder):
    done = run("recalibrate", folder / "model", folder / "rows.csv")
    assert done.exit_code == 2
    assert "--dry-run" in done.stderr
    other = run("recalibrate", folder / "model", folder / "rows.csv", "--dry-run", "--moved", "arm")
    assert other.exit_code == 2
    assert "'arm' is no choice" in other.stderr
