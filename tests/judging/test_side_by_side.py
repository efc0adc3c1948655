"""The same work for several items, in turn, in threads or in processes."""

import threading

import pytest
import torch
from testing.engine_work import square

from pisigma.judging.side_by_side import in_processes, side_by_side


@pytest.mark.parametrize(("wide", "threads"), [(True, 1), (False, 2)])
def test_results_stand_in_the_order_of_the_items(
    wide: bool, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    meeting = threading.Barrier(threads, timeout=60)

    def work(item: int) -> tuple[int, str]:
        meeting.wait()  # only where as many work at the same time does anybody go on
        return item, threading.current_thread().name

    results = list(side_by_side(work, range(6), wide))
    assert [item for item, _ in results] == list(range(6))
    assert len({name for _, name in results}) == threads


def test_a_failure_of_one_item_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)

    def work(item: int) -> int:
        return 1 // (item - 3)

    with pytest.raises(ZeroDivisionError):
        list(side_by_side(work, range(6), wide=False))


def test_processes_give_results_in_the_order_of_the_items() -> None:
    assert list(in_processes(square, [3, 1, 2], jobs=2)) == [9, 1, 4]


def test_an_item_that_ends_its_process_is_no_result() -> None:
    with pytest.raises(MemoryError):
        list(in_processes(square, [2, -1], jobs=1))
