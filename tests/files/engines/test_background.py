"""A process that computes for this one: results, errors, progress, and an end at any time."""

import math
import threading
import time
from functools import partial

import pytest

from pisigma.files.engines.background import BackgroundProcess, EndedError, compute_here
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


def test_progress_that_raises_ends_the_function_only(process):
    def stop(what):
        raise KeyError(what)

    with pytest.raises(KeyError):
        process.compute(REPORTS, stop)
    assert process.compute(partial(math.hypot, 3, 4)) == 5


def test_what_it_prints_is_not_taken_for_an_answer(process):
    assert process.compute(partial(print, "printed by the test")) is None


def test_the_process_ends_at_once():
    process, ended = BackgroundProcess(), []

    def wait():
        with pytest.raises(EndedError):
            process.compute(partial(time.sleep, 60))
        ended.append(time.monotonic())

    waiting = threading.Thread(target=wait)
    waiting.start()
    time.sleep(0.2)
    begun = time.monotonic()
    process.close()
    waiting.join()
    assert ended[0] - begun < 1
    with pytest.raises(EndedError):
        process.compute(partial(math.hypot, 3, 4))
