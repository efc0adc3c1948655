"""Work in processes of this machine, or in threads: an engine, and several tasks at once."""

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

import torch

from pisigma.files.engines.engine import ONE_THREAD, AbstractEngine, Item, Result, packed, unpacked, work_on
from pisigma.files.errors import PisigmaError


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


def side_by_side(tasks: Sequence[Callable[[], Result]], wide: bool) -> Iterator[Result]:
    """Give what every task returns, in their order.

    Small calibrations gain nothing from several threads in one matrix product, but they leave Python's lock to others
    in most of their time: with one thread each, two of them take 0.6 of the time that they take in turn.

    Args:
        tasks: none may change what others read.
        wide: whether one task alone keeps all cores busy, or needs so much memory that only one may have it.
    """
    workers = 1 if wide else min(len(tasks), torch.get_num_threads())
    if workers < 2:
        yield from (task() for task in tasks)
        return
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(lambda task: task(), tasks)


def in_processes(tasks: Sequence[Callable[[], Result]], jobs: int) -> Iterator[Result]:
    """Give what every task returns, in their order and as soon as that allows, from processes with one thread each.

    Args:
        tasks: each a `functools.partial` of a function of a module; the first is started first.
        jobs: processes at most.

    Raises:
        PisigmaError: a task raised it and all before that one returned, so that it does not depend on which ends first.
        MemoryError: a process ended twice with a task, as it does where memory is short.
    """
    engine, outcomes, due = ProcessEngine(min(jobs, len(tasks))), dict[int, Result | PisigmaError](), 0
    for (number, _), outcome in engine.results(_outcome, [*enumerate(tasks)], 1):
        if outcome is None:
            raise MemoryError
        outcomes[number] = outcome
        while due in outcomes:
            result = outcomes.pop(due)
            if isinstance(result, PisigmaError):
                raise result
            yield result
            due += 1


def _outcome(numbered: tuple[int, Callable[[], Result]]) -> Result | PisigmaError:
    """What a numbered task returns, or how it refuses."""
    try:
        return numbered[1]()
    except PisigmaError as refusal:
        return refusal
