"""`pisigma report`: a page, figures and JSON, of every kind of model, and refusals in one line."""

import json

import pytest
from testing.hybrid import joints_in
from testing.models import hand_made_model, no_type_checker
from testing.refusals import problem_of
from testing.report import geometric_under_test, hybrid_under_test, measured
from testing.screens import assert_screen

from pisigma.files.errors import ModelError, OutputError
from pisigma.files.model_files import CORRELATION_CSV, HELD_OUT_CSV
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model, save_model


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """A folder with a hybrid model and rows to judge it on."""
    folder = tmp_path_factory.mktemp("report")
    with no_type_checker():
        under_test, model = hybrid_under_test()
        (folder / "arm").mkdir()
        save_model(model, folder / "arm")
        measured(under_test, 50, seed=9).write_csv(folder / "rows.csv", model.robot)
    return folder


def test_a_report_is_written_and_its_verdict_printed(run, arm, tmp_path):
    result = run("report", arm / "arm", arm / "rows.csv", "--out", tmp_path / "page.html")
    assert result.exit_code == 0
    assert_screen(result.stdout, "50 rows")
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    assert (tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")


def test_json_is_one_object_with_the_figures(run, arm, tmp_path):
    page, figures = tmp_path / "page.html", tmp_path / "figures"
    result = run("report", arm / "arm", arm / "rows.csv", "--out", page, "--figures", figures, "--json")
    assert result.exit_code == 0
    assert result.stdout.count("\n") == 1
    found = json.loads(result.stdout)
    assert found["report"] == str(page)
    assert found["rows"] == {"count": 50, "origin": "other", "remarks": found["rows"]["remarks"]}
    assert set(found["figures"]) == {str(path) for path in figures.iterdir()}
    assert found["accuracy"][0]["models"]["hybrid"]["rms_mm"] > 0
    evaluated = json.loads(run("evaluate", arm / "arm", arm / "rows.csv", "--json").stdout)
    text = json.dumps(evaluated)
    assert str(found["accuracy"][0]["models"]["hybrid"]["rms_mm"])[:10] in text


def test_without_data_the_workspace_is_shown(run, arm, tmp_path):
    result = run("report", arm / "arm", "--out", tmp_path / "page.html", "--json")
    assert json.loads(result.stdout)["rows"] is None


@pytest.mark.parametrize("name", ["kiro3", "ur10"])
def test_networks_alone_are_reported(run, models, tmp_path, name):
    with no_type_checker():
        model = hand_made_model(name)
        q = model.starts[:30]
        T = model.forward(q)
        rows = Measurements(q=q, position=T[:, :3, 3], rotation=T[:, :3, :3])
        rows.write_csv(tmp_path / "rows.csv", model.robot)
    for data in ([], [tmp_path / "rows.csv"]):
        result = run("report", models / name, *data, "--out", tmp_path / "page.html")
        assert result.exit_code == 0, result.output


def test_a_geometric_model_is_reported(run, tmp_path):
    with no_type_checker():
        under_test, model = geometric_under_test()
        (tmp_path / "plain").mkdir()
        save_model(model, tmp_path / "plain")
        measured(under_test, 40, seed=9).write_csv(tmp_path / "rows.csv", model.robot)
    result = run("report", tmp_path / "plain", tmp_path / "rows.csv", "--out", tmp_path / "page.html")
    assert result.exit_code == 0, result.output


def test_calibrate_keeps_what_a_report_shows(run, tmp_path):
    with no_type_checker():
        under_test, model = geometric_under_test()
        rows = Measurements(
            q=joints_in(under_test.true.nominal, 60, 3),
            position=measured(under_test, 60, 3).position,
            frame=("</script>",) * 30 + ("$b",) * 30,
        )
        rows.write_csv(tmp_path / "rows.csv", model.robot)
    folder = tmp_path / "plain"
    made = ("calibrate", "rb5", tmp_path / "rows.csv", "--out", folder, "--model", "geometric", "--folds", 2)
    assert run(*made, "--set", "repeats=3").exit_code == 0
    assert {HELD_OUT_CSV, CORRELATION_CSV} <= {path.name for path in folder.iterdir()}
    section = load_model(folder).metrics["held_out_rows"]
    assert set(section) == {"sha256", "data_sha256"}
    for data in ([], [tmp_path / "rows.csv"]):
        result = run("report", folder, *data, "--out", tmp_path / "page.html", "--json")
        assert result.exit_code == 0, result.output
        found = json.loads(result.stdout)
        assert found["rows"]["origin"] == "held_out"
        assert found["held_out"]
        assert [frame["name"] for frame in found["frames"]] == ["</script>", "$b"]
        assert found["correlated"]
        page = (tmp_path / "page.html").read_text()
        assert page.count("</script>") == 3
        assert "repeated 3 times" in page
    (folder / HELD_OUT_CSV).write_text("q1_deg\n1\n")
    refused = run("report", folder, "--out", tmp_path / "page.html")
    assert isinstance(problem_of(refused), ModelError)


def test_wrong_outputs_are_refused(refuses, arm, tmp_path):
    refuses(
        "report",
        arm / "arm",
        "--out",
        tmp_path / "page.pdf",
        error=OutputError,
        file="page.pdf",
        value=".pdf",
    )
    (tmp_path / "taken").write_text("")
    page = ("report", arm / "arm", "--out", tmp_path / "page.html")
    refuses(*page, "--figures", tmp_path / "taken", error=OutputError, option="--figures", file="taken")
    refuses("report", tmp_path / "none", "--out", tmp_path / "page.html", error=ModelError)
    assert not (tmp_path / "page.html").exists()
