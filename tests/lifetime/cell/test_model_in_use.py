"""The model in use of a cell is followed: a change is taken over, and a model that cannot be loaded is reported."""

import os
import time

import pytest
from testing.cell_models import FIRST, SECOND, cell_of_two_models, put_into_use
from testing.refusals import refused

from pisigma.files.errors import ModelError, OutputError
from pisigma.lifetime.cell import model_in_use
from pisigma.lifetime.cell.history import History
from pisigma.lifetime.cell.model_in_use import ModelInUse


@pytest.fixture
def cell(tmp_path):
    return cell_of_two_models(tmp_path / "cell")


@pytest.fixture
def loads(cell):
    """The names of the models that were loaded, the model in use, and what happens while a model is loaded."""
    names, problems = [], {}

    def load(folder):
        if folder.name in problems:
            raise problems[folder.name]
        names.append(folder.name)

    return names, ModelInUse(cell.folder, "serve", load), problems


def test_a_change_is_loaded_once(cell, loads):
    names, in_use, _ = loads
    in_use.load_if_changed()
    put_into_use(cell, SECOND)
    in_use.load_if_changed()
    in_use.load_if_changed()
    assert names == [FIRST, SECOND]
    cell.use(None, "")
    in_use.load_if_changed()
    assert names == [FIRST, SECOND, FIRST]


def test_nothing_is_read_while_the_history_does_not_change(cell, loads, monkeypatch):
    _, in_use, _ = loads
    time.sleep(2 * model_in_use.SETTLED)
    in_use.load_if_changed()
    monkeypatch.setattr(model_in_use, "model_folder", None)
    in_use.load_if_changed()


def test_two_changes_within_the_rounding_of_file_times_are_both_seen(cell, loads, monkeypatch):
    names, in_use, _ = loads
    monkeypatch.setattr(model_in_use, "SETTLED", 60.0)  # however slow the machine is
    put_into_use(cell, SECOND)
    in_use.load_if_changed()
    same = in_use._state()
    monkeypatch.setattr(ModelInUse, "_state", lambda self: same)
    put_into_use(cell, FIRST)
    in_use.load_if_changed()
    assert names == [FIRST, SECOND, FIRST]


def test_a_model_that_cannot_be_loaded_leaves_the_one_before(cell, loads):
    names, in_use, problems = loads
    problems[SECOND] = ModelError("damaged", option=SECOND)
    reports = []
    in_use.follow(reports.append)
    put_into_use(cell, SECOND)
    until(lambda: reports)
    time.sleep(3 * model_in_use.INTERVAL)
    assert (len(reports), names, in_use.folder.name) == (1, [FIRST], FIRST)
    problems.clear()
    in_use.load_if_changed(retry_failed=True)
    assert (names, in_use.problem) == ([FIRST, SECOND], "")
    in_use.stop()


def test_changes_are_followed_though_nobody_reads_the_reports(cell, loads):
    _, in_use, problems = loads
    problems[SECOND] = ModelError("damaged", option=SECOND)
    reports = []

    def report(sentence):
        reports.append(sentence)
        raise BrokenPipeError

    in_use.follow(report)
    put_into_use(cell, SECOND)
    until(lambda: reports)
    problems.clear()
    put_into_use(cell, SECOND)
    put_into_use(cell, FIRST)
    put_into_use(cell, SECOND)
    until(lambda: in_use.folder.name == SECOND)
    in_use.stop()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_follows_changes_too(cell, loads):
    _, in_use, _ = loads
    in_use.follow()
    child = os.fork()
    if not child:
        end = time.monotonic() + 10
        while in_use.folder.name != SECOND and time.monotonic() < end:
            time.sleep(0.01)
        os._exit(in_use.folder.name != SECOND)
    put_into_use(cell, SECOND)
    assert os.waitpid(child, 0)[1] == 0
    in_use.stop()


def test_changes_are_followed_on_systems_without_fork(cell, loads, monkeypatch):
    monkeypatch.delattr(os, "register_at_fork")
    _, in_use, _ = loads
    in_use.follow()
    put_into_use(cell, SECOND)
    until(lambda: in_use.folder.name == SECOND)
    in_use.stop()


def test_findings_that_cannot_be_read_are_read_again(cell, loads, monkeypatch):
    names, in_use, _ = loads
    time.sleep(2 * model_in_use.SETTLED)
    in_use.load_if_changed()
    put_into_use(cell, SECOND)
    time.sleep(2 * model_in_use.SETTLED)
    with monkeypatch.context() as patched:
        patched.setattr(History, "controller", locked)
        in_use.load_if_changed()
    assert (names, bool(in_use.problem)) == ([FIRST], True)
    in_use.load_if_changed()
    assert (names, in_use.problem) == ([FIRST, SECOND], "")


def locked(history):
    raise OutputError("the history cannot be used: database is locked")


def test_a_cell_without_a_model_in_use_is_refused_at_first_and_reported_later(cell, loads):
    _, in_use, _ = loads
    put_into_use(cell, "")
    in_use.load_if_changed()
    assert (in_use.folder.name, bool(in_use.problem)) == (FIRST, True)
    with refused(ModelError, file=cell.folder):
        ModelInUse(cell.folder, "serve", lambda folder: None)


def until(happened, seconds=10.0):
    end = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.01)
