"""The history of a cell: whole transactions, in order, by two processes, and no file of another kind."""

import multiprocessing
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import astuple, fields, replace

import pytest
from testing.cell_before import cell_of_schema_1
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import MeasurementError, ModelError, OutputError
from pisigma.lifetime.cell.events import Event
from pisigma.lifetime.cell.history import (
    HISTORY,
    SCHEMA_VERSION,
    TABLES,
    Check,
    ControllerEntry,
    ExportEntry,
    History,
    InUse,
    ModelEntry,
    SessionEntry,
)
from pisigma.lifetime.monitoring.history import read_sessions

SESSION = SessionEntry("2026-01-10", "abc", "2026-01-10T09:00:00+00:00", "2026-01-10", 40, "position", 21.5)
MODEL = ModelEntry("a", "def", "2026-01-10T12:00:00+00:00", "2026-01-10", "2026-01-10", p95_mm=0.1)
EVENT = Event("2026-02-01", "mastering", "joint 3", "2026-02-01T08:00:00+00:00")
CHECK = Check("verify", "a", "2026-01-10", "better", "It is better.", None, True, "2026-01-11T08:00:00+00:00")
USE = InUse("a", "2026-01-11T08:00:00+00:00", "verified")
EXPORT = ExportEntry("dh.csv", "0123", "dh", "kinematics", "a", "2026-01-12T08:00:00+00:00")
ACTIVE = ControllerEntry("2026-01-13", "0123", "tried at low speed", "2026-01-13T08:00:00+00:00")


@pytest.fixture
def history(tmp_path):
    return History(tmp_path / HISTORY)


def test_a_history_without_entries_is_empty_and_has_no_file(history):
    assert (history.sessions(), history.events(), history.models(), history.checks()) == ((), (), (), ())
    assert history.in_use is None
    assert not history.path.exists()


def test_entries_are_read_as_they_were_written(history):
    history.add(SESSION, MODEL, EVENT, CHECK, USE, EXPORT, ACTIVE)
    other = History(history.path)
    assert other.sessions() == (SESSION,)
    assert other.models() == (MODEL,)
    assert other.events() == (EVENT,)
    assert other.checks() == (CHECK,)
    assert other.model_in_use_changes() == (USE,)
    assert other.exports() == (EXPORT,)
    assert other.controller() == (ACTIVE,)
    assert other.in_use == MODEL


def test_columns_are_the_attributes(history):
    history.add(SESSION)
    with closing(sqlite3.connect(history.path)) as database:
        assert database.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        for kind, table in TABLES.items():
            columns = [row[1] for row in database.execute(f"PRAGMA table_info({table.name})")]
            assert columns == [one.name for one in fields(kind)]


def test_sessions_are_in_the_order_of_their_days_and_replaced_by_name(history):
    earlier = replace(SESSION, name="b", day="2025-12-01")
    history.add(SESSION, earlier, replace(SESSION, set_aside="wrong tool"))
    assert [one.name for one in history.sessions()] == ["b", "2026-01-10"]
    assert history.sessions()[1].set_aside == "wrong tool"


def test_the_last_use_applies_and_the_earlier_ones_are_kept(history):
    history.add(MODEL, replace(MODEL, name="b"), USE, replace(USE, model="b"))
    assert history.in_use.name == "b"
    history.add(replace(USE, model=""))
    assert history.in_use is None
    assert [one.model for one in history.model_in_use_changes()] == ["a", "b", ""]


def test_twelve_changes_of_the_model_in_use_are_undone_one_after_the_other(history):
    names = [f"{number:02d}" for number in range(12)]
    history.add(*(replace(MODEL, name=name) for name in names))
    history.add(*(replace(USE, model=name) for name in names), replace(USE, model=names[-1]))
    for name in [*reversed(names[:-1]), ""]:
        assert history.model_after_undo == name
        history.add(replace(USE, model=name, undo=True))
    assert history.in_use is history.model_after_undo is None
    history.add(USE)
    assert history.model_after_undo == ""


def test_an_older_history_gets_the_tables_and_columns_that_it_lacks(history):
    with sqlite3.connect(history.path) as database:
        database.execute("CREATE TABLE uses (model TEXT NOT NULL, since TEXT NOT NULL, reason TEXT NOT NULL)")
        database.execute("INSERT INTO uses VALUES (?, ?, ?)", (USE.model, USE.since, USE.reason))
        database.execute("PRAGMA user_version = 1")
    database.close()
    assert history.model_in_use_changes() == (USE,)
    assert history.controller() == ()
    history.add(replace(USE, undo=True))
    assert [one.undo for one in history.model_in_use_changes()] == [False, True]


def test_a_missing_model_is_refused_with_the_nearest_name(history):
    history.add(MODEL)
    with refused(ModelError, option="model", value="A"):
        history.model("A")


def test_entries_are_added_together_or_not_at_all(history):
    history.add(SESSION)
    bad = replace(MODEL)
    object.__setattr__(bad, "sha256", None)
    with refused(OutputError, file=HISTORY):
        history.add(EVENT, bad)
    assert history.events() == ()


def test_a_newer_schema_is_refused(history):
    history.add(SESSION)
    with sqlite3.connect(history.path) as database:
        database.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    database.close()
    with refused(OutputError, file=HISTORY, value=SCHEMA_VERSION + 1):
        history.sessions()


def test_a_file_of_another_kind_is_refused_and_kept(history):
    history.path.write_text("no database at all, but longer than a header of SQLite")
    with refused(OutputError, file=HISTORY):
        history.add(SESSION)
    assert history.path.read_text().startswith("no database")


def _add(path, first):
    for number in range(first, first + 50):
        History(path).add(replace(SESSION, name=f"{number:03d}"))


def test_two_processes_lose_nothing(history):
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_add, args=(history.path, first)) for first in (0, 50)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert len(history.sessions()) == 100


HOLD_THE_LOCK = """
import pathlib, sys, time
from pisigma.lifetime.cell.events import Event
from pisigma.lifetime.cell.history import (History)
with History(pathlib.Path(sys.argv[1])).database.transaction() as database:
    database.execute("INSERT INTO events (day, kind, note, recorded) VALUES ('2026-01-01', 'tool', '', '')")
    print("locked", flush=True)
    time.sleep(600)
"""
FILL_THE_DISK = """
import pathlib, resource, sys
from pisigma.files.errors import OutputError
from pisigma.lifetime.cell.events import Event
from pisigma.lifetime.cell.history import (History)
resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, 60_000))
history = History(pathlib.Path(sys.argv[1]))
for number in range(1_000):
    try:
        history.record("firmware", note=f"{number} " + "x" * 3_000)
    except OutputError:
        break
print(number)
"""


def _started(script, path):
    command = [sys.executable, "-c", script, str(path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)


def test_a_killed_process_leaves_no_lock_behind(history, monkeypatch):
    history.add(SESSION)
    with _started(HOLD_THE_LOCK, history.path) as process:
        assert process.stdout.readline() == "locked\n"
        assert history.sessions() == (SESSION,)  # it can be read meanwhile
        monkeypatch.setattr("pisigma.lifetime.cell.database.LOCK_TIMEOUT", 0.1)
        with refused(OutputError, file=HISTORY):
            history.record("firmware")
        process.kill()
        process.wait()
        history.record("firmware")
    assert [one.kind for one in history.events()] == ["firmware"]


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of the size of files")
def test_a_full_disk_loses_nothing(history):
    history.add(SESSION, MODEL)
    with _started(FILL_THE_DISK, history.path) as process:
        written = int(process.stdout.read())
    assert 0 < written < 1_000
    assert [one.note.split()[0] for one in history.events()] == [str(number) for number in range(written)]
    assert (history.sessions(), history.models()) == ((SESSION,), (MODEL,))
    history.record("tool")


def test_an_acceptance_names_the_person_and_the_model_in_use(history):
    with refused(MeasurementError, option="--by"):
        history.record("accepted")
    with refused(ModelError):
        history.record("accepted", person="A. Auditor")
    history.add(MODEL, USE)
    with refused(MeasurementError, option="--date", value="2026-01-09"):
        history.record("accepted", "2026-01-09", person="A. Auditor")
    event = history.record("accepted", "2026-01-12", "on site", "A. Auditor")
    assert (event.person, event.model) == ("A. Auditor", MODEL.name)
    assert history.events() == (event,)


def test_texts_with_quotes_are_kept(history):
    event = history.record("tool", note="a 'new' tool; DROP TABLE events")
    assert history.events() == (event,)


@pytest.fixture
def older(tmp_path):
    """A cell that a version before schema version 2 wrote, with the history of its model."""
    return cell_of_schema_1(tmp_path)


def test_a_cell_of_schema_1_keeps_every_entry_and_the_monitored_sessions_of_its_models(older):
    history, beside = History(older / HISTORY), older / "models" / "2026-11-26.history.sqlite"
    with closing(sqlite3.connect(history.path)) as opened:
        stored = {
            one: opened.execute(f"SELECT * FROM {TABLES[one].name}").fetchall()
            for one in (SessionEntry, Event, ModelEntry, Check, InUse)
        }
    with closing(sqlite3.connect(beside)) as database:
        monitored = database.execute("SELECT model, rows, date, session, zeros FROM sessions").fetchall()
    assert len(monitored) == 3
    for kind, rows in stored.items():
        for one, row in zip(history.database.read(kind), rows, strict=True):
            assert astuple(one)[: len(row)] == row
    assert [
        (one.model_sha256, one.rows_sha256, one.day, one.session, one.arrays)
        for one in history.monitored_sessions()
    ] == monitored
    (model,) = history.models()
    assert [(one.day, one.rows, one.verdict) for one in history.monitored_sessions()] == [
        ("2026-06-01", 10, "unchanged"),
        ("2026-07-01", 10, "unchanged"),
        ("2026-08-01", 10, "moved"),
    ]
    for one, record in zip(history.monitored_sessions(), read_sessions(history, model.sha256), strict=True):
        assert_close(one.rms_mm, record.session.rms * 1e3)
        assert_close(one.rms_after_mm, record.session.rms_after_recalibration * 1e3)
        assert (one.verdict, one.unchanged) == (record.session.verdict, record.session.unchanged_probability)
    assert not beside.exists()
    assert history.database.upgrade() == SCHEMA_VERSION


@pytest.mark.parametrize("has_posterior", [True, False])
def test_an_upgrade_finds_out_which_models_have_a_posterior(older, has_posterior):
    description = older / "models" / "2026-11-26" / "model.yaml"
    if not has_posterior:
        description.write_text(description.read_text().replace("\nuncertainty:\n", "\nothers:\n"))
    assert [one.has_posterior for one in History(older / HISTORY).models()] == [has_posterior]


def test_the_history_of_a_model_outside_of_a_cell_is_upgraded_too(older, tmp_path):
    path = tmp_path / "mine.history.sqlite"
    (older / "models" / "2026-11-26.history.sqlite").rename(path)
    history = History(path)
    assert history.database.upgrade() == 0
    assert [one.day for one in history.monitored_sessions()] == ["2026-06-01", "2026-07-01", "2026-08-01"]
    assert {one.name for one in TABLES.values()} == _tables(path)


def _tables(path):
    with closing(sqlite3.connect(path)) as database:
        return {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}


def test_an_upgrade_is_complete_or_absent(older):
    history, beside = History(older / HISTORY), older / "models" / "2026-11-26.history.sqlite"
    content, before = beside.read_bytes(), history.path.read_bytes()
    beside.write_bytes(b"damaged" * 1_000)
    with refused(OutputError, file=beside.name):
        history.sessions()
    assert history.path.read_bytes() == before
    beside.write_bytes(content)
    assert len(history.monitored_sessions()) == 3


def test_two_processes_upgrade_at_once(older):
    context = multiprocessing.get_context("fork")
    workers = [context.Process(target=_add, args=(older / HISTORY, first)) for first in (0, 50)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0]
    history = History(older / HISTORY)
    assert (len(history.sessions()), len(history.monitored_sessions())) == (104, 3)


def test_a_history_is_read_by_other_programs(older):
    """pandas, where it is installed, or any other program that runs SQL; numbers are numbers."""
    history = History(older / HISTORY)
    history.database.upgrade()
    query = """SELECT s.name, s.rows, m.rms_mm, m.verdict FROM cell_sessions s
        JOIN monitored_sessions m ON m.day = s.day ORDER BY s.day"""
    with closing(sqlite3.connect(history.path)) as database:
        try:
            import pandas

            rows = list(pandas.read_sql(query, database).itertuples(index=False, name=None))
        except ImportError:
            rows = database.execute(query).fetchall()
    assert [row[:2] for row in rows] == [("2026-06-01", 10), ("2026-07-01", 10), ("2026-08-01", 10)]
    assert rows[0][2] < 0.1 < rows[2][2]
