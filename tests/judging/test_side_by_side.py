"""The same work for several items, in turn or in threads."""

import threading

import pytest
import torch

from pisigma.judging.side_by_side import side_by_side


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
