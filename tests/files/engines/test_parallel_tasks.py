"""Several tasks are run sequentially, in threads or in processes."""

import threading
from functools import partial

import pytest
import torch
from testing.engine_work import refuse, square
from testing.refusals import refused

from pisigma.files.engines.processes import run_in_processes, run_in_threads
from pisigma.files.errors import IdentificationError


@pytest.mark.parametrize(("one_at_a_time", "threads"), [(True, 1), (False, 2)])
def test_results_have_the_order_of_the_tasks(
    one_at_a_time: bool, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    meeting = threading.Barrier(threads, timeout=60)

    def work(item: int) -> tuple[int, str]:
        meeting.wait()  # continues only if this many threads work at the same time
        return item, threading.current_thread().name

    results = list(run_in_threads([partial(work, item) for item in range(6)], one_at_a_time))
    assert [item for item, _ in results] == list(range(6))
    assert len({name for _, name in results}) == threads


def test_a_failure_of_one_task_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    def work(item: int) -> int:
        return 1 // (item - 3)

    with pytest.raises(ZeroDivisionError):
        list(run_in_threads([partial(work, item) for item in range(6)], one_at_a_time=False))


def test_processes_keep_the_order_of_results_and_errors() -> None:
    tasks = [*(partial(square, number) for number in (3, 1, 2)), partial(refuse, 0.5), partial(refuse, 0.0)]
    results = run_in_processes(tasks, jobs=2)
    assert [next(results) for _ in range(3)] == [9, 1, 4]
    with refused(IdentificationError, value=0.5):
        next(results)


def test_a_task_that_kills_its_process_has_no_result() -> None:
    with pytest.raises(MemoryError):
        list(run_in_processes([partial(square, number) for number in (2, -1)], jobs=1))
