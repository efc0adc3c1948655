"""The same work for several items, on all cores that torch may use."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

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
