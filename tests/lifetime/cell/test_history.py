"""The history of a cell: whole transactions, in order, by two processes, and no file of another kind."""

import multiprocessing
import sqlite3
from dataclasses import fields, replace

import pytest
from testing.refusals import refused

from pisigma.files.errors import ModelError, OutputError
from pisigma.lifetime.cell.history import (
    HISTORY,
    SCHEMA_VERSION,
    Check,
    Event,
    History,
    ModelEntry,
    SessionEntry,
    Use,
)

SESSION = SessionEntry("2026-01-10", "abc", "2026-01-10T09:00:00+00:00", "2026-01-10", 40, "position", 21.5)
MODEL = ModelEntry("a", "def", "2026-01-10T12:00:00+00:00", "2026-01-10", "2026-01-10", p95_mm=0.1)
EVENT = Event("2026-02-01", "mastering", "joint 3", "2026-02-01T08:00:00+00:00")
CHECK = Check("verify", "a", "2026-01-10", "better", "It is better.", None, True, "2026-01-11T08:00:00+00:00")
USE = Use("a", "2026-01-11T08:00:00+00:00", "verified")


@pytest.fixture
def history(tmp_path):
    return History(tmp_path / HISTORY)


def test_nothing_is_known_and_no_file_is_made_before_the_first_entry(history):
    assert (history.sessions(), history.events(), history.models(), history.checks()) == ((), (), (), ())
    assert history.in_use is None
    assert not history.path.exists()


def test_entries_are_read_as_they_were_written(history):
    history.add(SESSION, MODEL, EVENT, CHECK, USE)
    other = History(history.path)
    assert other.sessions() == (SESSION,)
    assert other.models() == (MODEL,)
    assert other.events() == (EVENT,)
    assert other.checks() == (CHECK,)
    assert other.uses() == (USE,)
    assert other.in_use == MODEL


def test_columns_are_the_attributes(history):
    history.add(SESSION)
    with sqlite3.connect(history.path) as database:
        columns = [row[1] for row in database.execute("PRAGMA table_info(cell_sessions)")]
        assert database.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
    database.close()
    assert columns == [one.name for one in fields(SessionEntry)]


def test_sessions_are_in_the_order_of_their_days_and_replaced_by_name(history):
    earlier = replace(SESSION, name="b", day="2025-12-01")
    history.add(SESSION, earlier, replace(SESSION, set_aside="wrong tool"))
    assert [one.name for one in history.sessions()] == ["b", "2026-01-10"]
    assert history.sessions()[1].set_aside == "wrong tool"


def test_the_last_use_counts_and_the_earlier_ones_stay(history):
    history.add(MODEL, replace(MODEL, name="b"), USE, replace(USE, model="b"))
    assert history.in_use.name == "b"
    history.add(replace(USE, model=""))
    assert history.in_use is None
    assert [one.model for one in history.uses()] == ["a", "b", ""]


def test_a_model_that_is_not_there_is_refused_with_the_nearest_name(history):
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


def test_a_file_of_another_kind_is_refused_and_stays(history):
    history.path.write_text("no database at all, but longer than a header of SQLite")
    with refused(OutputError, file=HISTORY):
        history.add(SESSION)
    assert history.path.read_text().startswith("no database")


def _add(path, first):
    for number in range(first, first + 50):
        History(path).add(replace(SESSION, name=f"{number:03d}"))


def test_two_processes_lose_nothing(history):
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_add, args=(history.path, first)) for first in (0, 50)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(60)
    assert [worker.exitcode for worker in workers] == [0, 0]
    assert len(history.sessions()) == 100
