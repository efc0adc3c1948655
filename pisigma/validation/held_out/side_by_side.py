"""Several tasks at once, on all cores that torch may use, or in several processes."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

from pisigma.files.engines.processes import ProcessEngine
from pisigma.files.errors import PisigmaError

Result = TypeVar("Result")


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
