"""Functions that engines run in other processes."""

import os
import time
from collections.abc import Callable

from pisigma.files.engines.engine import AbstractEngine, pack_arguments, process_chunk, unpack_results
from pisigma.files.errors import IdentificationError


def square(number: int) -> int:
    """Return the square; -1 ends the process."""
    if number == -1:
        os._exit(1)
    return number * number


def environment(name: str) -> tuple[str | None, int]:
    """Return an environment variable and the process ID."""
    return os.environ.get(name), os.getpid()


def refuse(after: float) -> None:
    """Raise an error after some seconds."""
    time.sleep(after)
    raise IdentificationError("refused", value=after)


class PicklingEngine(AbstractEngine):
    """Pickles work, items and results as for other processes, but runs the work in this process."""

    def __init__(self, workers: int = 1, before_each: Callable[[], None] = lambda: None) -> None:
        self._workers, self._before_each = workers, before_each

    @property
    def workers(self) -> int:
        return self._workers

    def _chunks(self, work, chunks):
        """See `AbstractEngine`."""
        for chunk, arguments in [(chunk, pack_arguments(work, chunk)) for chunk in chunks]:
            self._before_each()
            yield chunk, unpack_results(process_chunk(*arguments))
