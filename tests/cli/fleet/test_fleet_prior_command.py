"""`pisigma fleet prior` and `pisigma calibrate --prior`."""

import json

import pytest
from testing.engine_work import PicklingEngine
from testing.fleet_robots import NOMINAL, few_steps, rows_of
from testing.models import REPOSITORY
from testing.screens import assert_screen

from pisigma.files.errors import ModelError, PisigmaError
from pisigma.model.folder.model_folder import load_model
from pisigma.workflow.fleet import run as workflow

pytest.importorskip("pyarrow", reason="Parquet comes with the extra fleet")

MODEL = REPOSITORY / "models" / "kiro3"


@pytest.fixture(scope="module")
def prior(tmp_path_factory, run):
    """Cells of five robots and of three bad ones, few rows of another robot, and the prior of the five."""
    folder = tmp_path_factory.mktemp("prior")
    (folder / "in").mkdir()
    for k in range(5):
        rows_of(k, 30, k).write_csv(folder / "in" / f"r{k}.csv", NOMINAL)
    for name in ("bad", "bad_robot"):
        (folder / "in" / f"{name}.csv").write_text("q1_deg,x_mm\n1,2\n", encoding="utf-8")
    metres = (folder / "in" / "r0.csv").read_text(encoding="utf-8").replace("_mm", "_m")
    (folder / "in" / "metres.csv").write_text(metres, encoding="utf-8")
    rows_of(50, 10, 1).write_csv(folder / "few.csv", NOMINAL)
    cells = folder / "cells"
    assert run("new", "rb5", "--from", folder / "in", "--out", cells).exit_code == 0
    (cells / "bad_robot" / "cell.yaml").write_text("robot: robot.yaml\n", encoding="utf-8")
    (cells / "bad_robot" / "robot.yaml").write_text("name: 3\n", encoding="utf-8")
    with few_steps():
        made = run("fleet", "prior", cells, "--out", folder / "prior")
    assert made.exit_code == 0, made.output
    return folder, made


def test_what_the_robots_have_in_common_is_printed_and_kept(prior):
    folder, made = prior
    assert_screen(made.stdout, "5 robots", "gravity", "3 warnings", heading="Prior")
    card = (folder / "prior" / "README.md").read_text(encoding="utf-8")
    assert "5 robots of the type rb5" in card
    assert "| a_2 | mm |" in card
    for name in ("bad", "bad_robot", "metres"):
        assert f"Robot '{name}' was not used: " in card
    assert "`pisigma fleet prior cells " in card


def test_a_calibration_of_ten_poses_starts_from_the_prior(prior, run):
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


def test_a_prior_is_not_monitored(prior, refuses):
    folder, _ = prior
    refuses("monitor", folder / "prior", folder / "few.csv", error=ModelError)


def test_what_does_not_go_with_a_prior_is_refused(prior, refuses, tmp_path):
    folder, _ = prior
    one = "--prior", folder / "prior"
    for command, error in (
        (("calibrate", "ur5", folder / "few.csv", *one), ModelError),
        (("calibrate", "rb5", folder / "few.csv", *one, "--model", "geometric"), PisigmaError),
        (("calibrate", "rb5", folder / "few.csv", "--prior", MODEL), ModelError),
    ):
        refuses(*command, "--out", tmp_path / "x", error=error)
        assert not (tmp_path / "x").exists()
    refuses("fleet", "run", folder / "cells", "--prior", MODEL, error=ModelError)


def test_cells_begin_with_it(prior, run, monkeypatch):
    folder, _ = prior
    monkeypatch.setattr(workflow, "ProcessEngine", PicklingEngine)
    cells = folder / "later"
    (folder / "new").mkdir()
    (folder / "few.csv").rename(folder / "new" / "few.csv")
    assert run("new", "rb5", "--from", folder / "new", "--out", cells).exit_code == 0
    done = run("fleet", "run", cells, "--prior", folder / "prior", "--jobs", "1", "--json")
    assert done.exit_code == 0, done.output
    (model,) = (cells / "few" / "models").iterdir()
    assert load_model(model).metrics["parent"]["kind"] == "fleet_prior"
