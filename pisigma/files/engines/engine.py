"""Interface of engines, which run a function for many items on one machine or on several."""

import math
import pickle
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeVar

from pisigma.files.plugins import Plugins, loaded_plugins

Item = TypeVar("Item")
Result = TypeVar("Result")

ONE_THREAD: Final = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Environment of all workers. With one thread each, sums have the same order, and results have the same bits for any
number of workers."""


class AbstractEngine(ABC):
    """Interface of engines that run a function for many items in other processes.

    The function itself writes its results, so that an interrupted call loses only the items in progress.
    """

    @abstractmethod
    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """Yield every finished chunk with its results, or with None instead of results if the worker died."""

    def results(
        self, work: Callable[[Item], Result], items: Sequence[Item], chunk: int
    ) -> Iterator[tuple[Item, Result | None]]:
        """Yield every item with its result as they finish.

        If a worker is killed or runs out of memory, its items are tried once more, one at a time. An item whose
        worker dies again has the result None.

        Args:
            work: function to call with each item: a function at module level, or a `functools.partial` of one.
            items: the items to process; items and results are pickled. Workers first load the plug-ins of this
                process.
            chunk: number of items that a worker gets at a time, which should be a few seconds of work.
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
        """Number of workers."""


def pack_arguments(work: Callable[[Item], Result], chunk: Sequence[Item]) -> tuple[Plugins, bytes]:
    """Return the plug-ins and the pickled work and chunk; plug-ins are separate because workers load them first."""
    return loaded_plugins(), pickle.dumps((work, list(chunk)))


def process_chunk(plugins: Plugins, pickled: bytes) -> bytes:
    """Process a chunk in a worker, and return the pickled results."""
    plugins.load()
    work, chunk = pickle.loads(pickled)
    return pickle.dumps([work(item) for item in chunk])


def unpack_results(pickled: bytes) -> list[Any]:
    """Return the results of `process_chunk`."""
    results: list[Any] = pickle.loads(pickled)
    return results
