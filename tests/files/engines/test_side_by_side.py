"""Several tasks, in turn, in threads or in processes."""

import threading
from functools import partial

import pytest
import torch
from testing.engine_work import refuse, square

from pisigma.files.engines.processes import in_processes, side_by_side
from pisigma.files.errors import IdentificationError


@pytest.mark.parametrize(("wide", "threads"), [(True, 1), (False, 2)])
def test_results_stand_in_the_order_of_the_tasks(
    wide: bool, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    meeting = threading.Barrier(threads, timeout=60)

    def work(item: int) -> tuple[int, str]:
        meeting.wait()  # only where as many work at the same time does anybody go on
        return item, threading.current_thread().name

    results = list(side_by_side([partial(work, item) for item in range(6)], wide))
    assert [item for item, _ in results] == list(range(6))
    assert len({name for _, name in results}) == threads


def test_a_failure_of_one_task_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    def work(item: int) -> int:
        return 1 // (item - 3)

    with pytest.raises(ZeroDivisionError):
        list(side_by_side([partial(work, item) for item in range(6)], wide=False))


def test_processes_keep_the_order_of_results_and_of_the_first_refusal() -> None:
    tasks = [*(partial(square, number) for number in (3, 1, 2)), partial(refuse, 0.5), partial(refuse, 0.0)]
    results = in_processes(tasks, jobs=2)
    assert [next(results) for _ in range(3)] == [9, 1, 4]
    with pytest.raises(IdentificationError, match=r"0.5 s"):
        next(results)


def test_a_task_that_ends_its_process_has_no_result() -> None:
    with pytest.raises(MemoryError):
        list(in_processes([partial(square, number) for number in (2, -1)], jobs=1))
