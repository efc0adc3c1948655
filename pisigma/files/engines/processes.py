"""The engine of processes on this machine."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from pisigma.files.engines.engine import ONE_THREAD, AbstractEngine, Item, Result, packed, unpacked, work_on


class ProcessEngine(AbstractEngine):
    """Works in processes of this machine, which start afresh and end with this one."""

    def __init__(self, workers: int) -> None:
        """Take so many processes."""
        self._workers = workers

    @property
    def workers(self) -> int:
        """How many processes work side by side."""
        return self._workers

    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """See `AbstractEngine`; as many chunks as workers are handed out, so that a broken pool loses no others."""
        waiting = list(reversed(chunks))
        while waiting:
            running: dict[Future[bytes], Sequence[Item]] = {}
            with self._pool(min(self._workers, len(waiting))) as pool:
                broken = False
                while running or (waiting and not broken):
                    while waiting and not broken and len(running) < self._workers:
                        chunk = waiting.pop()
                        try:
                            running[pool.submit(work_on, *packed(work, chunk))] = chunk
                        except BrokenProcessPool:
                            waiting.append(chunk)
                            broken = True
                    for ended in wait(running, return_when=FIRST_COMPLETED).done:
                        chunk = running.pop(ended)
                        try:
                            yield chunk, unpacked(ended.result())
                        except BrokenProcessPool:
                            broken = True
                            yield chunk, None

    @contextmanager
    def _pool(self, workers: int) -> Iterator[ProcessPoolExecutor]:
        """A pool whose processes have one thread each; they are ended where the block ends with an exception."""
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, context, initializer=_begin)
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise
        else:
            pool.shutdown()
        finally:
            for name, value in before.items():
                os.environ.pop(name, None) if value is None else os.environ.__setitem__(name, value)


def _begin(*_: Any) -> None:
    """Leave interruptions to the process that started this one, and end with it however it ends."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()
