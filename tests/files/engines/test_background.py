"""A process that computes for this one: results, errors, progress, and an end at any time."""

import math
import os
import pickle
import threading
import time
from functools import partial

import pytest

from pisigma.files.engines.processes import BackgroundProcess, ProcessEndedError, compute_here
from pisigma.files.progress import _within_stage

REPORTS = partial(_within_stage, prefix="fold ", what="1 of 2")


@pytest.fixture(scope="module")
def process():
    started = BackgroundProcess()
    yield started
    started.close()


def test_it_computes_what_this_process_computes(process):
    for compute in (compute_here, process.compute):
        said = []
        assert compute(partial(math.hypot, 3, 4)) == 5
        with pytest.raises(ValueError, match="math domain error"):
            compute(partial(math.sqrt, -1))
        compute(REPORTS, said.append)
        assert said == ["fold 1 of 2"]


def test_it_imports_nothing_from_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "pisigma.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    process = BackgroundProcess()
    assert process.compute(partial(math.hypot, 3, 4)) == 5
    process.close()


@pytest.mark.skipif(not hasattr(os, "nice"), reason="no priorities on this system")
def test_it_leaves_the_processor_to_this_process(process):
    assert process.compute(partial(os.nice, 0)) == min(os.nice(0) + 10, 19)


def test_progress_that_raises_ends_the_function_only(process):
    def stop(what):
        raise KeyError(what)

    with pytest.raises(KeyError):
        process.compute(REPORTS, stop)
    assert process.compute(partial(math.hypot, 3, 4)) == 5


class Source:
    """The function `work` of a source text, because the process cannot import modules of tests."""

    def __init__(self, text):
        self.text = text

    def __call__(self, **given):
        raise AssertionError("it runs in the process only")

    def __reduce__(self):
        return eval, (f"(lambda names: exec({self.text!r}, names) or names['work'])({{}})",)


STUBBORN = Source("""
def work(progress):
    for what in ("a", "b", "c"):
        try:
            progress(what)
        except Exception:
            pass
    return "earlier"
""")
UNUSUAL = Source("""
class UnusualError(Exception):
    def __init__(self, first, second):
        super().__init__(f"{first} and {second}")

def work():
    raise UnusualError("one", "two")
""")


def test_no_result_is_that_of_an_earlier_function(process):
    def stop(what):
        raise KeyError(what)

    with pytest.raises(KeyError):
        process.compute(STUBBORN, stop)
    assert process.compute(partial(math.hypot, 3, 4)) == 5


def test_results_and_errors_that_cannot_be_pickled_are_errors(process):
    with pytest.raises(TypeError):
        process.compute(threading.Lock)
    with pytest.raises(RuntimeError, match="UnusualError"):
        process.compute(UNUSUAL)
    with pytest.raises((AttributeError, pickle.PicklingError)):
        process.compute(lambda: 1)
    assert process.compute(partial(math.hypot, 3, 4)) == 5


def test_an_interrupted_call_ends_the_process(monkeypatch):
    process = BackgroundProcess()
    with monkeypatch.context() as patch:

        def interrupted():
            raise KeyboardInterrupt

        patch.setattr(process, "_receive", interrupted)
        with pytest.raises(KeyboardInterrupt):
            process.compute(partial(math.hypot, 3, 4))
    with pytest.raises(ProcessEndedError):
        process.compute(partial(math.hypot, 6, 8))
    process.close()


def test_what_it_prints_is_not_taken_for_an_answer(process):
    assert process.compute(partial(print, "printed by the test")) is None


def test_the_process_ends_at_once():
    process, ended = BackgroundProcess(), []

    def wait():
        with pytest.raises(ProcessEndedError):
            process.compute(partial(time.sleep, 60))
        ended.append(time.monotonic())

    waiting = threading.Thread(target=wait)
    waiting.start()
    time.sleep(0.2)
    begun = time.monotonic()
    process.close()
    waiting.join()
    assert ended[0] - begun < 1
    with pytest.raises(ProcessEndedError):
        process.compute(partial(math.hypot, 3, 4))
