"""Where the same work for many items is done: on this machine or on many, behind one interface."""

import math
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

from pisigma.files.plugins import Plugins, loaded

Item = TypeVar("Item")
Result = TypeVar("Result")

ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of all workers: sums come in the same order however many there are, so results do to the bit."""


class AbstractEngine(ABC):
    """Does the same work for many items in other processes.

    What works on an item writes what it came to itself, so that an ended call loses only what was being worked on.
    """

    @abstractmethod
    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """Every chunk with its results in the order in which they end, None where its worker ended before."""

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item], chunk: int
    ) -> Iterator[tuple[Item, Result | None]]:
        """Give every item with its result, in the order in which they end.

        Where a worker is killed or runs out of memory, the items that it had are tried once more, one at a time; the
        item that a worker ends with again has no result.

        Args:
            work: what is done with an item: a function of a module, or a `functools.partial` of one.
            items: the items; they and the results are pickled. Workers first load the plug-ins of this process.
            chunk: so many are given to a worker at once; some seconds of work.
        """
        size = max(1, min(chunk, math.ceil(len(items) / self.workers)))
        lost: list[Item] = []
        for those, results in self._chunks(work, [items[k : k + size] for k in range(0, len(items), size)]):
            if results is None:
                lost += those
            else:
                yield from zip(those, results, strict=True)
        for item in lost:
            for _, results in self._chunks(work, [[item]]):
                yield item, None if results is None else results[0]

    @property
    @abstractmethod
    def workers(self) -> int:
        """How many work side by side."""


def packed(work: Callable[[Item], Result], chunk: Sequence[Item]) -> tuple[Plugins, bytes]:
    """Give the arguments of `work_on`: plug-ins are loaded before what they define is unpickled."""
    return loaded(), pickle.dumps((work, list(chunk)))


def work_on(plugins: Plugins, pickled: bytes) -> bytes:
    """Work on a chunk, in a worker; gives the results, pickled."""
    plugins.load()
    work, chunk = pickle.loads(pickled)
    return pickle.dumps([work(item) for item in chunk])


def unpacked(pickled: bytes) -> list[Any]:
    """Give the results of `work_on`."""
    results: list[Any] = pickle.loads(pickled)
    return results
