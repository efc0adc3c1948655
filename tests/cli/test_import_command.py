"""`pisigma import`: the table, consent, saved mappings, joins, one JSON object."""

import json
from pathlib import Path

import pytest

from pisigma.files.errors import MeasurementError, OutputError

EXPORTS = Path(__file__).parents[1] / "measurement" / "foreign" / "exports"
LOG, POINTS = EXPORTS / "polyworks_log.csv", EXPORTS / "polyworks_points.csv"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "data.csv"


def test_without_a_terminal_it_shows_the_table_and_ends_with_2(refuses, out):
    message = refuses("import", EXPORTS / "kuka.csv", "--out", out, stdout=None)
    assert "--yes" in message
    assert "--map" in message
    assert not out.exists()


@pytest.mark.parametrize(("answer", "status"), [(True, 0), (False, 2)])
def test_the_import_asks_on_a_terminal(run, out, monkeypatch, answer, status):
    monkeypatch.setattr("pisigma.cli.import_._is_asked", lambda: True)
    monkeypatch.setattr("typer.confirm", lambda question: answer)
    assert run("import", EXPORTS / "kuka.csv", "--out", out).exit_code == status
    assert out.exists() == answer


def test_yes_writes_the_file(run, out):
    result = run("import", EXPORTS / "kuka.csv", "--out", out, "--yes")
    assert result.exit_code == 0
    assert "A1          10.500  q1_deg     name of KUKA" in result.stdout
    assert "6 measurements" in result.stdout
    assert out.read_text().startswith(
        "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n"
    )


def test_a_saved_map_needs_no_consent(run, out, tmp_path):
    saved = tmp_path / "map.yaml"
    arguments = ("import", POINTS, LOG, "--join", "point", "--out", out)
    first = run(*arguments, "--yes", "--save-map", saved)
    assert first.exit_code == 0
    assert "Nominal X: '-'" in saved.read_text()
    text = out.read_text()
    out.unlink()
    second = run(*arguments, "--map", saved)
    assert second.exit_code == 0, second.output
    assert out.read_text() == text


def test_json_is_one_object(run, out):
    result = run("import", LOG, POINTS, "--join", "point", "--out", out, "--yes", "--json")
    printed = json.loads(result.stdout)
    assert result.stderr == ""
    assert (printed["file"], printed["rows"], len(printed["left_out"])) == (str(out), 6, 2)
    assert printed["columns"][1] == {
        "file": str(LOG),
        "column": 2,
        "heading": "J1 (deg)",
        "read_as": "q1_deg",
        "reason": "heading",
    }
    asked = run("import", LOG, POINTS, "--join", "point", "--out", out, "--json")
    assert asked.exit_code == 2
    assert json.loads(asked.stdout)["file"] is None


@pytest.mark.parametrize(
    ("options", "error", "word", "fields"),
    [
        (("--unit", "mn"), MeasurementError, "'mn'", {}),
        (("--map", "X=x_mn"), MeasurementError, "'x_mn'", {}),
        (("--map", "Q=x_mm"), MeasurementError, "'A1'", {}),
        (("--rotation", "kuca"), MeasurementError, "'kuka'", {}),
        (("--within", "soon"), MeasurementError, "200ms", {"value": "soon"}),
        (("--join", "point"), MeasurementError, "--map", {"option": "--join", "value": "point"}),
        (("--save-map", "map.csv"), OutputError, ".yaml", {"file": "map.csv"}),
    ],
)
def test_options_that_do_not_fit(refuses, out, options, error, word, fields):
    command = ("import", EXPORTS / "kuka.csv", "--out", out, "--yes", *options)
    assert word in refuses(*command, stdout=None, error=error, **fields)
    assert not out.exists()


def test_a_unit_that_no_column_needs_does_not_matter(run, out):
    assert run("import", EXPORTS / "kuka.csv", "--out", out, "--yes", "--unit", "rad").exit_code == 0


def test_time_stamps_within_a_duration(run, refuses, out):
    files = (EXPORTS / "leica_list.txt", EXPORTS / "leica_log.csv")
    assert run("import", *files, "--join", "time", "--within", "200ms", "--out", out, "--yes").exit_code == 0
    message = refuses(
        "import",
        *files,
        "--join",
        "time",
        "--within",
        "0.01s",
        "--out",
        out,
        "--yes",
        stdout=None,
        error=MeasurementError,
    )
    assert "0.01 s" in message
    assert "0.05" in message


def test_an_input_is_not_written_over(refuses):
    refuses("import", LOG, "--out", LOG, "--yes", error=OutputError, file="polyworks_log.csv")


def test_calibrate_names_the_command(refuses, tmp_path):
    assert "pisigma import" in refuses(
        "calibrate",
        "ur10",
        EXPORTS / "staubli.csv",
        "--out",
        tmp_path / "model",
        error=MeasurementError,
        file="staubli.csv",
        line=1,
        value="0xb0",
    )
