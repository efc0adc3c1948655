"""A cell from its drawing to a recalibrated model: every step finds its rows and settings, and status the next step."""

import dataclasses

import numpy as np
import pytest
from testing.cell_rows import ROBOT, day, measured
from testing.closeness import assert_close
from testing.models import no_type_checker
from testing.refusals import refused
from testing.simulated_arm import BASE

import pisigma
from pisigma.files.errors import AcceptanceError, MeasurementError, ModelError, OutputError
from pisigma.measurement.camera.camera_files import CameraFiles, Repeatability
from pisigma.measurement.dataset import Measurements
from pisigma.model.folder.model_folder import load_model
from pisigma.workflow.calibrate import calibrate
from pisigma.workflow.cell import new_files
from pisigma.workflow.cell.cell import Cell
from pisigma.workflow.settings.calibration import CalibrationSettings


@pytest.fixture(scope="module", autouse=True)
def quick_pictures(blank_pictures):
    with no_type_checker():
        yield


@pytest.fixture(scope="module")
def year(tmp_path_factory):
    """A cell that was calibrated, verified, and recalibrated after a collision; with every state on the way."""
    cell = Cell.create(tmp_path_factory.mktemp("cells") / "welder7", "ur10", limit_mm=0.5)
    states = [cell.status().step.state]

    def then(step):
        result = step()
        states.append(cell.status().step.state)
        return result

    then(lambda: cell.plan(candidates=200, count=12, check=2))
    then(lambda: cell.add_session(measured(60, 1), day=day(60)))
    calibrated = then(lambda: cell.calibrate(folds=2))
    then(lambda: cell.add_session(measured(12, 2), day=day(30)))
    verified = then(cell.verify)
    then(lambda: cell.add_session(measured(12, 3, zero=0.08), day=day(2)))
    return cell, states, calibrated, verified


def test_status_names_every_step_on_the_way(year):
    _, states, _, _ = year
    assert states[:-2] == ["no_plan", "not_measured", "not_calibrated", "not_verified", "not_verified"]
    assert states[-1] == "session_not_judged"


def test_the_model_is_that_of_the_rows_without_a_cell_to_the_bit(year):
    cell, _, (calibration, entry), _ = year
    rows = Measurements.read_csv(cell.folder / "sessions" / f"{day(60)}.csv", ROBOT)
    alone = calibrate("ur10", rows, CalibrationSettings(folds=0))
    assert np.array_equal(alone.model.identified.dh, calibration.model.identified.dh)
    assert_close(
        load_model(cell.model_folder(entry.name)).identified.dh, alone.model.identified.dh, atol=1e-14
    )


def test_the_first_model_is_put_into_use_when_it_is_verified(year):
    cell, _, (_, entry), (verification, verified) = year
    assert verification.verdict == "better"
    assert (verified, cell.history.in_use) == (entry, entry)
    assert cell.model.name == entry.name


def test_a_move_is_found_and_recalibrated(year):
    cell, *_ = year
    found = cell.monitor()
    assert [one["what"] for one in found.sessions_of_call[-1].to_json()["moved"]] == ["joint 3"]
    assert cell.status().step.state == "moved"
    assert [one.day for one in cell.history.monitored_sessions()] == [day(30), day(2)]
    assert not list((cell.folder / "models").glob("*.sqlite"))
    result, entry = cell.recalibrate()
    assert result.trusted
    assert cell.history.in_use == entry
    assert entry.parent == cell.history.models()[0].name
    assert cell.status().step.state == "up_to_date"  # held-out rows of the session confirm the limit
    assert 0 < entry.p95_mm < 0.5
    cell.use(entry.parent, "try")
    assert cell.history.in_use.name == entry.parent
    cell.use(entry.name, "back")


def test_rows_that_improve_the_model_are_used_without_a_move_and_a_moved_tracker_becomes_an_event(year):
    cell, *_ = year
    cell.add_session(measured(12, 11, zero=0.088), day=day(1))
    cell.monitor()
    assert cell.status().step.state in ("moved", "older_than_evidence")
    cell.recalibrate()
    cell.add_session(measured(12, 12, zero=0.088, base=np.add(BASE, [0.5, 0.2, 0, 0.3, 0, 0])), day=day(0))
    cell.monitor()
    assert cell.status().step.state == "moved"
    assert cell.recalibrate()[0].trusted
    assert [(one.kind, one.day) for one in cell.history.events()] == [("instrument", day(0))]
    assert cell.status().step.state == "up_to_date"


def test_a_plan_for_a_model_has_few_and_other_poses_and_is_measured_next(year):
    cell, *_ = year
    planned, path = cell.plan(candidates=200)
    assert (planned.calibration_pose_count, planned.test_pose_count) == (10, 0)
    assert cell.status().step.state in ("up_to_date", "session_not_judged")  # no plan was due
    settings = cell.file.plan_settings(cell.status().facts, count=12)
    assert (settings.count, settings.check, settings.seed) == (12, 0, 2)
    path.unlink()


@pytest.mark.parametrize("again", ["same", "file"])
def test_rows_that_the_cell_contains_are_refused(year, again, tmp_path):
    cell, *_ = year
    rows = measured(12, 2)
    if again == "file":
        rows.write_csv(tmp_path / "again.csv", ROBOT)
        rows = tmp_path / "again.csv"
    with refused(MeasurementError):
        cell.add_session(rows, day=day(1))


def test_rows_in_inches_are_refused_and_not_stored(year):
    cell, *_ = year
    before = cell.history.sessions()
    with refused(AcceptanceError):
        cell.add_session(measured(12, 5, scale=1 / 25.4), day=day(1))
    assert cell.history.sessions() == before
    assert cell.status().facts.unrecorded_files == ()


def test_a_file_that_was_edited_is_named_and_not_used(year):
    cell, *_ = year
    path = cell.folder / "sessions" / f"{day(60)}.csv"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"0", b"1", 1))
    try:
        assert cell.status().step.state == "edited_session"
        with refused(MeasurementError, file=f"{day(60)}.csv"):
            cell.calibrate()
    finally:
        path.write_bytes(content)
    assert cell.status().step.state != "edited_session"


@pytest.mark.parametrize("file", ["model.yaml", "model.safetensors"])
def test_a_changed_model_is_named_and_not_used(year, file):
    cell, *_ = year
    entry = cell.history.in_use
    path = cell.folder / "models" / entry.name / file
    content = path.read_bytes()
    path.write_bytes(content + b"\n")
    try:
        assert cell.status().step.state == "model_changed"
        with refused(ModelError):
            cell.use(entry.name, "")
        with refused(ModelError):
            pisigma.load(cell.folder)
    finally:
        path.write_bytes(content)


def test_an_event_that_is_recorded_during_a_calibration_asks_for_another(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    cell.add_session(measured(14, 1), day="2026-01-10")
    cell.add_session(measured(8, 2), day="2026-01-12")

    def record(_):
        if not cell.history.events():
            cell.history.record("instrument", "2026-01-11")

    _, entry = cell.calibrate(record, model="geometric", folds=2)
    assert entry.frame_day == ""
    assert cell.status().step.state == "fitted_before_event"
    _, again = cell.calibrate(model="geometric", folds=0)
    assert again.frame_day == "2026-01-11"
    assert cell.status().step.state == "not_verified"


def test_sessions_before_and_after_an_event_of_the_instrument_are_in_two_frames(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    moved = np.add(BASE, [0.5, 0.2, 0, 0.3, 0, 0])
    cell.add_session(measured(30, 1), day="2026-01-10")
    cell.history.record("instrument", "2026-01-15")
    cell.add_session(measured(30, 2, base=moved), day="2026-01-20")
    rows = cell.sessions.rows_of(cell.history.sessions())
    assert set(rows.frame) == {"", "since 2026-01-15"}
    calibration, entry = cell.calibrate(model="geometric", folds=0)
    assert calibration.trusted
    assert set(calibration.model.bases) == {"", "since 2026-01-15"}
    assert (entry.frame_day, entry.target_day) == ("2026-01-15", "")
    cell.add_session(measured(12, 3, base=moved), day="2026-02-01")
    verification, _ = cell.verify()
    assert verification.verdict == "better"
    assert not verification.settings.fit_frame
    cell.history.record("instrument", "2026-02-02")
    cell.add_session(measured(12, 4), day="2026-02-03")
    assert cell.status().step.command.split()[1] == "verify"  # a geometric model has no posterior to monitor
    cell.plan(count=4, candidates=60)
    again, _ = cell.verify()
    assert again.settings.fit_frame
    assert again.verdict == "better"
    older = cell.add_session(measured(12, 5), day="2026-01-12")
    assert cell.sessions.rows_with_model_names(entry, cell.sessions.rows_of_file(older), older.day).fit_frame
    cell.history.record("mastering", "2026-02-10")
    assert cell.status().step.state == "no_plan"
    with refused(MeasurementError):
        cell.calibrate()


def test_the_missing_poses_of_a_plan_are_requested(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    cell.plan(count=40, check=0, candidates=100)
    cell.add_session(measured(20, 1), day=day(2))
    step = cell.status().step
    assert (step.state, step.command.split()[1]) == ("session_incomplete", "import")
    cell.add_session(measured(16, 2), day=day(1))
    assert cell.status().step.state == "not_calibrated"


def test_a_file_in_the_folder_of_sessions_is_taken_in_by_the_next_step(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    measured(40, 1).write_csv(cell.folder / "sessions" / "by hand 2026-01-10.csv", ROBOT)
    assert cell.status().facts.unrecorded_files == ("by hand 2026-01-10.csv",)
    _, entry = cell.calibrate(model="geometric", folds=0)
    assert entry.sessions == "by hand 2026-01-10"
    assert cell.status().facts.unrecorded_files == ()
    (one,) = cell.history.sessions()
    assert dataclasses.replace(one, sha256="", taken_in="", remark="").day == "2026-01-10"


def test_a_session_is_set_aside_with_a_reason(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    cell.add_session(measured(20, 1), day="2026-01-10")
    with refused(MeasurementError, option="--set-aside"):
        cell.sessions.set_aside("2026-01-10", " ")
    with refused(MeasurementError, option="session", value="2026-01-1"):
        cell.sessions.set_aside("2026-01-1", "wrong tool")
    cell.sessions.set_aside("2026-01-10", "wrong tool")
    assert cell.status().step.state == "no_plan"
    assert (cell.folder / "sessions" / "2026-01-10.csv").exists()


def test_a_folder_with_files_does_not_become_a_cell(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with refused(OutputError, file=tmp_path):
        Cell.create(tmp_path, "ur10")


def test_a_new_calibration_goes_into_use_only_where_new_rows_show_that_it_is_better(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    cell.add_session(measured(14, 1), day="2026-01-10")
    cell.calibrate(model="geometric", folds=0)
    cell.add_session(measured(8, 2), day="2026-01-11")
    cell.verify()
    first = cell.history.in_use
    cell.add_session(measured(60, 3), day="2026-01-12")
    cell.add_session(measured(30, 4), day="2026-01-13")
    _, entry = cell.calibrate(model="geometric", folds=0)
    assert first is not None
    assert cell.history.in_use == entry
    same, again = cell.calibrate(model="geometric", folds=0)
    assert same.trusted
    assert cell.history.in_use == entry
    assert again.name not in {one.model for one in cell.history.model_in_use_changes()}


def test_load_takes_the_model_in_use(year, tmp_path):
    cell, *_ = year
    ik = pisigma.load(cell.folder)
    assert ik.model.name == cell.history.in_use.name
    empty = Cell.create(tmp_path / "empty", "ur10")
    with refused(ModelError, file=empty.folder):
        pisigma.load(empty.folder)


def test_a_session_never_replaces_a_file_that_appeared_meanwhile(tmp_path, monkeypatch):
    (tmp_path / "2026-01-10.csv").write_text("another process")
    offered = iter([tmp_path / "2026-01-10.csv", tmp_path / "2026-01-10-2.csv"])
    monkeypatch.setattr(new_files, "free_path", lambda *arguments: next(offered))
    path = new_files.write_under_new_name(tmp_path, "2026-01-10", b"rows", ())
    assert path.read_bytes() == b"rows"
    assert (tmp_path / "2026-01-10.csv").read_text() == "another process"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["2026-01-10-2.csv", "2026-01-10.csv"]


def test_rows_before_and_after_an_event_in_one_file_are_refused(tmp_path):
    cell = Cell.create(tmp_path / "cell", "ur10")
    days = ("2026-01-10",) * 15 + ("2026-01-12",) * 15
    cell.add_session(dataclasses.replace(measured(30, 1), date=days))
    cell.history.record("instrument", "2026-01-11")
    with refused(MeasurementError, value="instrument"):
        cell.calibrate(model="geometric", folds=0)
    with refused(MeasurementError, option="--date", value="2026-01-12"):
        cell.add_session(dataclasses.replace(measured(30, 2), date=days), day="2026-01-12")


def test_a_recalibration_with_an_older_session_keeps_the_day_of_the_model(year):
    cell, *_ = year
    entry = cell.history.models()[-1]
    assert entry.day == max(
        one.day for one in cell.history.sessions() if one.name in entry.sessions.split(",")
    )


def test_cameras_are_copied_whole_and_never_over_another_file(tmp_path):
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "camera.yaml").write_text(folder)
    (tmp_path / "board.yaml").write_text("board")
    left, right, board = (
        str(tmp_path / name) for name in ("left/camera.yaml", "right/camera.yaml", "board.yaml")
    )
    repeatability = Repeatability(5e-5, 1e-3)
    cell = Cell.create(
        tmp_path / "one",
        "ur10",
        "camera",
        cameras=CameraFiles((left,), (board,), repeatability=repeatability),
    )
    assert cell.cameras.repeatability.length == pytest.approx(5e-5)
    assert cell.cameras.repeatability.angle == pytest.approx(1e-3)
    with refused(OutputError, value="camera.yaml"):
        Cell.create(tmp_path / "two", "ur10", "camera", cameras=CameraFiles((left, right), (board,)))
