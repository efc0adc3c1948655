"""`pisigma fleet prior` and `pisigma calibrate --prior`."""

import json

import pytest
from testing.fleet_robots import DRAWN, rows_of
from testing.models import REPOSITORY

pytest.importorskip("pyarrow", reason="Parquet comes with the extra fleet")

MODEL = REPOSITORY / "models" / "kiro3"


@pytest.fixture(scope="module")
def prior(tmp_path_factory, run):
    """A folder with five robots and three bad ones, few rows of another robot, and the prior of the five."""
    folder = tmp_path_factory.mktemp("prior")
    (folder / "in").mkdir()
    for k in range(5):
        rows_of(k, 30, k).write_csv(folder / "in" / f"r{k}.csv", DRAWN)
    (folder / "in" / "bad.csv").write_text("q1_deg,x_mm\n1,2\n", encoding="utf-8")
    (folder / "in" / "undrawn").mkdir()
    (folder / "in" / "undrawn" / "robot.yaml").write_text("name: 3\n", encoding="utf-8")
    (folder / "in" / "undrawn" / "rows.csv").write_text("q1_deg,x_mm\n1,2\n", encoding="utf-8")
    metres = (folder / "in" / "r0.csv").read_text(encoding="utf-8").replace("_mm", "_m")
    (folder / "in" / "metres.csv").write_text(metres, encoding="utf-8")
    rows_of(50, 10, 1).write_csv(folder / "few.csv", DRAWN)
    made = run("fleet", "prior", folder / "in", "--robot", "rb5", "--out", folder / "prior")
    assert made.exit_code == 0, made.output
    return folder, made


def test_what_the_robots_have_in_common_is_printed_and_kept(prior):
    folder, made = prior
    assert "what 5 robots have in common" in made.stdout
    assert all(len(line) <= 80 for line in made.stdout.splitlines())
    card = (folder / "prior" / "README.md").read_text(encoding="utf-8")
    assert "5 robots of the type rb5" in card
    assert "| a_2 | mm |" in card
    for name in ("bad", "undrawn", "metres"):
        assert f"Robot '{name}' did not count: " in card
    assert "millimetres that are named metres" in card
    assert "Made by `pisigma fleet prior in " in card


def test_a_calibration_of_ten_poses_begins_with_it(prior, run):
    folder, _ = prior
    done = run(
        "calibrate", "rb5", folder / "few.csv", "--prior", folder / "prior", "--out", folder / "m", "--json"
    )
    assert done.exit_code == 0, done.output
    report = json.loads(done.stdout)
    assert report["kept"] in ("recalibrated", "old")
    assert report["parent"]["kind"] == "fleet_prior"
    assert report["moved"] == []
    assert (folder / "m" / "model.yaml").is_file()


def test_a_prior_is_not_monitored(prior, run):
    folder, _ = prior
    done = run("monitor", folder / "prior", folder / "few.csv")
    assert done.exit_code == 2, done.output
    assert "a model of one robot was wanted" in " ".join(done.output.split())


def test_what_does_not_go_with_a_prior_is_refused(prior, run, tmp_path):
    folder, _ = prior
    one = "--prior", folder / "prior"
    for command, complaint in (
        (("calibrate", "ur5", folder / "few.csv", *one), "is of robot 'rb5' and not of 'ur5'"),
        (
            ("calibrate", "rb5", folder / "few.csv", *one, "--model", "geometric"),
            "model: a calibration that begins",
        ),
        (("calibrate", "rb5", folder / "few.csv", "--prior", MODEL), "is a model of one robot"),
        (("fleet", "run", folder / "in", "--robot", "rb5", "--prior", MODEL), "is a model of one robot"),
        (("fleet", "run", folder / "in", "--robot", "rb5", *one, "--model", "geometric"), "leave this out"),
    ):
        done = run(*command, "--out", tmp_path / "x")
        assert done.exit_code == 2, done.output
        assert complaint in " ".join(done.output.split())
        assert not (tmp_path / "x").exists()
