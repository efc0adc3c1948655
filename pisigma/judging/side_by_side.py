"""The same work for several items, on all cores that torch may use, or in several processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch

from pisigma.engines.processes import ProcessEngine

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(work: Callable[[Item], Result], items: Sequence[Item], wide: bool) -> Iterator[Result]:
    """Give the results of all items in their order.

    Small calibrations gain nothing from several threads in one matrix product, but they leave Python's lock to others
    in most of their time: with one thread each, two of them take 0.6 of the time that they take in turn.

    Args:
        work: what is done with an item; it must not change what others read.
        items: the items.
        wide: whether one item alone keeps all cores busy, or needs so much memory that only one may have it.
    """
    workers = 1 if wide else min(len(items), torch.get_num_threads())
    if workers < 2:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(work, items)


def in_processes(work: Callable[[Item], Result], items: Sequence[Item], jobs: int) -> Iterator[Result]:
    """Give the results of all items in their order, worked out in processes with one thread each.

    Args:
        work: what is done with an item, of a module or a `functools.partial` of one.
        items: the items.
        jobs: processes at most.

    Raises:
        MemoryError: a process ended twice with an item, as it does where memory is short.
    """
    numbered = dict(enumerate(items))
    engine, results = ProcessEngine(min(jobs, len(items))), dict[int, Result]()
    for (number, _), result in engine.results(_Numbered(work), [*numbered.items()], 1):
        if result is None:
            raise MemoryError
        results[number] = result
    yield from (results[number] for number in numbered)


@dataclass(frozen=True)
class _Numbered(Generic[Item, Result]):
    """Work on an item that has a number, which tells results apart."""

    work: Callable[[Item], Result]

    def __call__(self, numbered: tuple[int, Item]) -> Result:
        return self.work(numbered[1])
