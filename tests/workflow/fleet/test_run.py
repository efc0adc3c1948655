"""Advancing all cells of a folder: results, resuming, and cells that need attention."""

import resource
import shutil
import sys

import pytest
from testing.aged import original_model, rows_after_change
from testing.engine_work import PicklingEngine
from testing.refusals import refused

from pisigma.files.errors import PlanningError
from pisigma.lifetime.fleet.status import FleetStatus
from pisigma.model.folder.model_folder import load_model
from pisigma.workflow.cell.new_cell import NewCell
from pisigma.workflow.fleet import run as workflow
from pisigma.workflow.fleet.manifest import new_cells
from pisigma.workflow.fleet.run import run_fleet
from pisigma.workflow.settings.fleet import FleetSettings

parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet comes with the extra fleet")
ONE_JOB = FleetSettings(jobs=1)


@pytest.fixture(scope="module", autouse=True)
def in_this_process():
    """Engines have tests of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workflow, "ProcessEngine", PicklingEngine)
        yield


def write_plant(folder):
    """Write three cells, of which the file of one is bad."""
    for number in range(2):
        rows_after_change(20, number).write_csv(folder / f"{number}.csv", original_model().robot)
    (folder / "bad.csv").write_text("q1_deg\nx\n", encoding="utf-8")
    (folder / "fleet.csv").write_text(
        "id,data,date,options\n"
        "r0,0.csv,2026-10-01,model=geometric\n"
        "r1,1.csv,2026-10-01,model=geometric; free=joint_offsets\n"
        "r2,bad.csv,2026-10-01,model=geometric\n",
        encoding="utf-8",
    )
    new_cells(folder / "fleet.csv", folder / "cells", NewCell("rb5"))
    return folder / "cells"


@pytest.fixture
def plant(tmp_path):
    return write_plant(tmp_path)


@pytest.fixture(scope="module")
def advanced_once(tmp_path_factory):
    """The first run of a plant, and a copy of the plant after it."""
    run = run_fleet(write_plant(tmp_path_factory.mktemp("plant")), ONE_JOB)
    return run, shutil.copytree(run.results.parent, run.results.parent.with_name("kept"))


@pytest.fixture
def first(advanced_once):
    """The first run of a plant, which is as it left it."""
    run, kept = advanced_once
    shutil.rmtree(run.results.parent)
    shutil.copytree(kept, run.results.parent)
    return run


def table_of(run):
    rows = parquet.read_table(run.results).to_pylist()
    return [(row["cell"], row["command"], row["verdict"]) for row in rows], rows


def test_an_invalid_file_is_named_and_does_not_affect_the_others(first):
    run, plant = first, first.results.parent
    assert (run.cells, run.cells_not_refused, run.unchanged) == (3, 2, 0)
    ((cell, reason),) = run.refused
    assert cell == "r2"
    assert "2026-10-01.csv" in reason
    checks, rows = table_of(run)
    assert checks == [
        ("r0", "calibrate", "trusted"),
        ("r1", "calibrate", "trusted"),
        ("r2", "import", "refused"),
    ]
    assert len(rows[0]["parameters"]) > len(rows[1]["parameters"]) > 0
    remarks = {one["remark"] for one in rows[0]["parameters"]}
    assert remarks > {"identified"}  # others are identified only in a sum
    assert 0 < rows[0]["rms_mm"] < 1
    assert load_model(plant / "r0" / "models" / rows[0]["model"]).robot.name == "rb5"
    assert FleetStatus.read(plant).states == {"file_refused": ("r2",), "not_verified": ("r0", "r1")}


def test_a_later_call_continues(first):
    plant, content = first.results.parent, first.results.read_bytes()
    again = run_fleet(plant, ONE_JOB)
    assert (again.unchanged, again.refused) == (2, first.refused)
    assert again.results.read_bytes() == content
    again.results.unlink()  # parameters are then read from the models
    assert run_fleet(plant, ONE_JOB).results.read_bytes() == content
    rows_after_change(31, 5).write_csv(plant / "r2" / "sessions" / "2026-10-01.csv", original_model().robot)
    last = run_fleet(plant, ONE_JOB)
    assert (last.unchanged, last.cells_not_refused, last.refused) == (2, 3, ())


def test_a_cell_is_calibrated_again_if_its_model_is_gone_or_its_settings_were_edited(first):
    plant = first.results.parent
    first.results.unlink()
    (model,) = (plant / "r0" / "models").iterdir()
    shutil.rmtree(model)
    with (plant / "r1" / "cell.yaml").open("a", encoding="utf-8") as file:
        file.write("  robust: false\n")
    last = run_fleet(plant, ONE_JOB)
    assert (last.unchanged, last.refused) == (0, first.refused)
    checks, rows = table_of(last)
    assert [cell for cell, command, _ in checks if command == "calibrate"] == ["r0", "r0", "r1", "r1"]
    assert [bool(row["parameters"]) for row in rows[:4]] == [False, True, True, True]
    assert run_fleet(plant, ONE_JOB).unchanged == 2


def test_a_folder_without_cells_is_refused(tmp_path):
    with refused(PlanningError, value=str(tmp_path)):
        run_fleet(tmp_path, ONE_JOB)


def test_nothing_is_written_without_the_package_of_the_engine(plant, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError):
        run_fleet(plant, FleetSettings(engine="ray"))
    assert not (plant / "results.parquet").exists()
    assert not (plant / "r0" / "history.sqlite").exists()


def test_a_full_disk_loses_nothing_and_a_later_call_continues(plant):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))
    try:
        full = run_fleet(plant, ONE_JOB)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(dict(full.refused)) == ["r0", "r1", "r2"]
    assert not list(plant.rglob("model.yaml"))
    assert run_fleet(plant, ONE_JOB).cells_not_refused == 2
