"""Calibration of a fleet: outputs, resuming, and refusals."""

import math
import resource
import sys
from dataclasses import replace

import pytest
from testing.aged import model_before, rows_later
from testing.refusals import refused

from pisigma.files.engines.processes import ProcessEngine
from pisigma.files.errors import FleetError, OutputError
from pisigma.lifetime.fleet.record import read_records
from pisigma.model.folder.model_folder import load_model, save_model
from pisigma.workflow.fleet import run as workflow
from pisigma.workflow.fleet.run import run_fleet
from pisigma.workflow.settings.fleet import FleetSettings

parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet comes with the extra fleet")


class InThisProcess(ProcessEngine):
    """Works in this process, as the engines have tests of their own."""

    def _chunks(self, work, chunks):
        for chunk in chunks:
            yield chunk, [work(item) for item in chunk]


@pytest.fixture(autouse=True)
def in_this_process(monkeypatch):
    monkeypatch.setattr(workflow, "ProcessEngine", InThisProcess)


@pytest.fixture
def plant(tmp_path):
    """Three robots, of which the file of one is bad."""
    for number in range(2):
        rows_later(20, number).write_csv(tmp_path / f"{number}.csv", model_before().robot)
    (tmp_path / "bad.csv").write_text("q1_deg\nx\n", encoding="utf-8")
    lines = (
        "id,robot,data,date,options",
        "r0,rb5,0.csv,2026-10-01,",
        "r1,rb5,1.csv,2026-10-01,free=joint_offsets",
    )
    (tmp_path / "fleet.csv").write_text(
        "\n".join((*lines, "r2,rb5,bad.csv,2026-10-01,", "")), encoding="utf-8"
    )
    return tmp_path


SETTINGS = FleetSettings(calibration=workflow.CalibrationSettings(model="geometric"), jobs=1)


def test_a_bad_file_is_named_and_does_not_stop_the_others(plant):
    run = run_fleet(plant / "fleet.csv", plant / "out", SETTINGS)
    assert (len(run.records), run.done, run.resumed) == (3, 2, 0)
    ((robot, reason),) = run.refused
    assert robot == "r2"
    assert "bad.csv" in reason
    assert load_model(plant / "out" / "models" / "r0" / "2026-10-01").robot.name == "rb5"
    table = parquet.read_table(run.results).to_pylist()
    assert [(row["robot"], row["verdict"]) for row in table] == [
        ("r0", "calibrated"),
        ("r1", "calibrated"),
        ("r2", "refused"),
    ]
    assert len(table[0]["parameters"]) > len(table[1]["parameters"]) > 0
    assert 0 < table[0]["rms_mm"] < 1


def test_a_later_call_resumes(plant):
    run_fleet(plant / "fleet.csv", plant / "out", SETTINGS)
    content = (plant / "out" / "results.parquet").read_bytes()
    (plant / "out" / "records" / "r1.json").unlink()
    (plant / "out" / "records" / "r0.json").write_text("{", encoding="utf-8")  # as a bad disk leaves it
    run = run_fleet(plant / "fleet.csv", plant / "out", SETTINGS)
    assert run.resumed == 1
    assert (plant / "out" / "results.parquet").read_bytes() == content
    rows_later(31, 5).write_csv(plant / "bad.csv", model_before().robot)
    run = run_fleet(plant / "fleet.csv", plant / "out", SETTINGS)
    assert (run.resumed, run.done, run.refused) == (2, 3, ())


def test_sessions_recalibrate_or_are_monitored(plant):
    save_folder = plant / "first"
    save_folder.mkdir()
    save_model(model_before(), save_folder)
    for month, moved in ((11, 0.0), (12, math.radians(0.25))):
        shift = (0.0, 0.0, moved, 0.0, 0.0, 0.0)
        rows_later(10, month, shift).write_csv(plant / f"2025-{month}-01.csv", model_before().robot)
    rows = "".join(f"a,rb5,2025-{month}-01.csv,first\n" for month in (11, 12))
    (plant / "aged.csv").write_text(f"id,robot,data,model\n{rows}", encoding="utf-8")
    monitored = run_fleet(plant / "aged.csv", plant / "watched", FleetSettings(task="monitor", jobs=1))
    (robot,) = monitored.records
    assert [one.verdict for one in robot.sessions] == ["unchanged", "moved"]
    assert robot.sessions[1].recalibrate
    renewed = run_fleet(plant / "aged.csv", plant / "renewed", FleetSettings(task="recalibrate", jobs=1))
    (robot,) = renewed.records
    assert [one.model for one in robot.sessions] == ["models/a/2025-11-01", "models/a/2025-12-01"]
    assert (robot.sessions[1].verdict, robot.sessions[1].moved) == ("recalibrated", True)
    theta = {one.name: one for one in robot.sessions[1].parameters}["theta_3"]
    assert theta.unit == "deg"
    assert 0 < theta.standard_error < 0.1
    last = load_model(plant / "renewed" / robot.sessions[1].model)
    assert last.metrics["parent"]["name"] == "2025-11-01"


def test_outputs_that_are_not_a_fleets_are_refused(plant):
    (plant / "mine").mkdir()
    (plant / "mine" / "notes.txt").write_text("mine", encoding="utf-8")
    with refused(OutputError, expected="the folder of a fleet, or an empty folder", file=plant / "mine"):
        run_fleet(plant / "fleet.csv", plant / "mine", SETTINGS)
    for out in (".", "fleet.csv"):
        with pytest.raises(OutputError):
            run_fleet(plant / "fleet.csv", plant / out, SETTINGS)
    assert (plant / "mine" / "notes.txt").read_text(encoding="utf-8") == "mine"
    with pytest.raises(FleetError):
        read_records(plant)


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ("folds=3", {"value": "folds"}),
        ("model=neural", {"value": "neural"}),
        ("prior_length=long", {"value": "long"}),
        ("prior_length=-1", {"option": "prior_length and prior_angle"}),
        ("seed", {"value": "seed", "remedy": ""}),
        ("seed=1; seed=2", {"value": "seed", "remedy": "state it once"}),
    ],
)
def test_options_of_one_robot_are_checked_before_the_work(plant, options, fields):
    path = plant / "options.csv"
    path.write_text(f"id,robot,data,options\nr0,rb5,0.csv,{options}\n", encoding="utf-8")
    with refused(FleetError, **fields) as caught:
        run_fleet(path, plant / "out", SETTINGS)
    assert "'r0'" in str(caught.value)
    assert not (plant / "out").exists()


def test_a_bad_option_stops_only_its_robot(plant):
    path = plant / "options.csv"
    bad = {"r1": "folds=3", "r2": "prior_length"}
    rows = "".join(f"{name},rb5,{name[1]}.csv,{option}\n" for name, option in ({"r0": ""} | bad).items())
    path.write_text(f"id,robot,data,options\n{rows}", encoding="utf-8")
    run = run_fleet(path, plant / "out", SETTINGS)
    assert [name for name, _ in run.refused] == list(bad)
    assert "folds" in run.refused[0][1]
    assert "prior_length" in run.refused[1][1]
    assert run.done == 1


@pytest.mark.parametrize("row", ["r1,rb5,1.csv,May,", "r1,rb5,1.csv", "r1,,1.csv,2026-10-01,"])
def test_a_bad_row_stops_only_its_robot(plant, row):
    path = plant / "rows.csv"
    path.write_text(f"id,robot,data,date,options\nr0,rb5,0.csv,2026-10-01,\n{row}\n", encoding="utf-8")
    run = run_fleet(path, plant / "out", SETTINGS)
    ((robot, reason),) = run.refused
    assert (robot, run.done) == ("r1", 1)
    assert "rows.csv, line 3" in reason
    assert [one.robot for one in read_records(plant / "out")] == ["r0"]


@pytest.mark.parametrize("task", ["monitor", "recalibrate"])
def test_a_task_that_needs_a_hybrid_is_refused_before_the_work(plant, task):
    with refused(FleetError, value=task):
        run_fleet(plant / "fleet.csv", plant / "out", replace(SETTINGS, task=task))
    assert not (plant / "out").exists()


def test_nothing_is_written_without_the_package_of_the_engine(plant, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError):
        run_fleet(plant / "fleet.csv", plant / "out", replace(SETTINGS, engine="ray"))
    assert not (plant / "out").exists()


def test_a_full_disk_loses_nothing_and_a_later_call_resumes(plant):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))
    try:
        full = run_fleet(plant / "fleet.csv", plant / "out", SETTINGS)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    reasons = dict(full.refused)
    assert "File too large" in reasons["r0"]
    assert not list((plant / "out" / "models").rglob("model.yaml"))
    assert run_fleet(plant / "fleet.csv", plant / "out", SETTINGS).done == 2
