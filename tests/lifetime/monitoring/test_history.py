"""History of a model: each session once, sorted by date, consistent after a kill; other files are refused."""

import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from testing.closeness import assert_close
from testing.refusals import refused

from pisigma.files.errors import OutputError
from pisigma.lifetime.cell.history import History
from pisigma.lifetime.cell.layout import CELL_FILE, history_of_model
from pisigma.lifetime.monitoring.history import Record, store_sessions
from pisigma.lifetime.monitoring.session import JointZeros, SessionResult
from pisigma.lifetime.recalibration.movement import Movement


def record(number, date="2026-01-01"):
    moved = (Movement("joint 3", 0.05, 0.002, "deg", 0.999),)
    session = SessionResult(
        10, 1e-9, moved, (("joint 3", 0.9),), 1e-4 * number, 5e-5, 1.0, 1.1, 30, ("base",), (True, False)
    )
    zeros = JointZeros(
        torch.tensor([1e-3, 2e-3]).double(),
        torch.ones(2).double(),
        torch.ones(2, 3).double(),
        torch.eye(2).double(),
    )
    return Record(f"rows_{number}.csv", date, f"hash {number}", 21.5 if number % 2 else None, session, zeros)


def test_sessions_are_stored_once_and_sorted_by_date(tmp_path):
    history = History(tmp_path / "model.history.sqlite")
    store_sessions(history, "model", [record(1, "2026-03-01"), record(2, "2026-02-01")])
    records = store_sessions(history, "model", [record(3, "2026-04-01"), record(1, "2026-03-01")])
    assert [one.file for one in records] == ["rows_2.csv", "rows_1.csv", "rows_3.csv"]
    assert records[1].session == record(1).session
    assert (records[0].temperature_c, records[1].temperature_c) == (None, 21.5)
    for name in ("shift", "sigma", "model_sensitivity", "session_covariance"):
        assert_close(getattr(records[0].zeros, name), getattr(record(2).zeros, name))


def test_every_model_has_its_own_history(tmp_path):
    history = History(tmp_path / "model.history.sqlite")
    store_sessions(history, "old", [record(1)])
    assert [one.file for one in store_sessions(history, "new", [record(2)])] == ["rows_2.csv"]


def test_the_history_of_a_model_outside_of_a_cell_is_next_to_its_folder(tmp_path):
    assert history_of_model(tmp_path / "cell_7").path == tmp_path / "cell_7.history.sqlite"
    assert history_of_model(f"{tmp_path}/cell_7/").path == tmp_path / "cell_7.history.sqlite"


def test_the_history_of_a_model_in_a_cell_is_that_of_the_cell(tmp_path):
    (tmp_path / CELL_FILE).touch()
    assert history_of_model(tmp_path / "models" / "first").path == tmp_path / "history.sqlite"


@pytest.mark.parametrize("content", [b"no history", b"SQLite format 3\x00 and then nothing"])
def test_other_files_are_refused_and_not_changed(tmp_path, content):
    path = tmp_path / "model.history.sqlite"
    path.write_bytes(content)
    with refused(OutputError, file="model.history.sqlite"):
        store_sessions(History(path), "model", [record(1)])
    assert path.read_bytes() == content


def test_a_kill_loses_nothing(tmp_path):
    history = History(tmp_path / "model.history.sqlite")
    store_sessions(history, "model", [record(0)])
    script = (
        "import sys; sys.path[:0] = sys.argv[2:]; from test_history import record; import pathlib, itertools\n"
        "from pisigma.lifetime.cell.history import History\n"
        "from pisigma.lifetime.monitoring.history import store_sessions\n"
        "for n in itertools.count(1):\n"
        "    store_sessions(History(pathlib.Path(sys.argv[1])), 'model', [record(2 * n), record(2 * n + 1)])\n"
        "    print(n, flush=True)\n"
    )
    command = [sys.executable, "-c", script, str(history.path), os.path.dirname(__file__), *sys.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        written = 1 + len(process.stdout.read().split())
    records = store_sessions(history, "model", [])
    assert len(records) % 2 == 1  # pairs are written together
    assert len(records) >= 1 + 2 * written
