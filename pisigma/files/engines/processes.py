"""Run work in processes or threads of this machine, or on Ray: many items, parallel tasks, and a process in waiting."""

import contextlib
import logging
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any

from pisigma.files.engines.engine import (
    ONE_THREAD,
    AbstractEngine,
    Item,
    Result,
    pack_arguments,
    process_chunk,
    unpack_results,
)
from pisigma.files.errors import PisigmaError
from pisigma.files.plugins import loaded_plugins
from pisigma.files.progress import Progress


class ProcessEngine(AbstractEngine):
    """Engine that runs a function for many items in new processes of this machine, which end with this one."""

    def __init__(self, workers: int) -> None:
        """Make an engine that uses `workers` processes."""
        self._workers = workers

    @property
    def workers(self) -> int:
        """Number of processes."""
        return self._workers

    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """See `AbstractEngine`; only one chunk per worker is submitted, so that a broken pool loses no others."""
        waiting = list(reversed(chunks))
        while waiting:
            running: dict[Future[bytes], Sequence[Item]] = {}
            with self._pool(min(self._workers, len(waiting))) as pool:
                broken = False
                while running or (waiting and not broken):
                    while waiting and not broken and len(running) < self._workers:
                        chunk = waiting.pop()
                        try:
                            running[pool.submit(process_chunk, *pack_arguments(work, chunk))] = chunk
                        except BrokenProcessPool:
                            waiting.append(chunk)
                            broken = True
                    for ended in wait(running, return_when=FIRST_COMPLETED).done:
                        chunk = running.pop(ended)
                        try:
                            yield chunk, unpack_results(ended.result())
                        except BrokenProcessPool:
                            broken = True
                            yield chunk, None

    @contextmanager
    def _pool(self, workers: int) -> Iterator[ProcessPoolExecutor]:
        """Yield a pool of processes with one thread each; an exception in the block terminates them."""
        before = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        context = multiprocessing.get_context("spawn")
        pool = ProcessPoolExecutor(workers, context, initializer=_start_worker)
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


def _start_worker(*_: Any) -> None:
    """Ignore interrupts, which the parent process handles, and exit when the parent exits."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=follow, daemon=True).start()


def run_in_threads(tasks: Sequence[Callable[[], Result]], one_at_a_time: bool) -> Iterator[Result]:
    """Run tasks in threads and yield their results in the order of the tasks.

    Small calibrations gain nothing from several threads in one matrix product, but they release Python's lock most
    of the time: two calibrations in parallel, with one thread each, take 0.6 of the time that they take sequentially.

    Args:
        tasks: functions without arguments, none of which may change data that others read.
        one_at_a_time: whether to run the tasks sequentially, because a single task keeps all cores busy or needs much
            memory.
    """
    import torch  # imported here, so that workers, which import this module, start faster

    workers = 1 if one_at_a_time else min(len(tasks), torch.get_num_threads())
    if workers < 2:
        yield from (task() for task in tasks)
        return
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(lambda task: task(), tasks)


def run_in_processes(tasks: Sequence[Callable[[], Result]], jobs: int) -> Iterator[Result]:
    """Run tasks in processes with one thread each, and yield their results in the order of the tasks.

    Args:
        tasks: the tasks, each a `functools.partial` of a function at module level; they are started in this order.
        jobs: largest number of processes.

    Raises:
        PisigmaError: a task raised this error. It is passed on after all earlier tasks have returned, so that the
            outcome does not depend on which task ends first.
        MemoryError: the process of a task died twice, usually because memory ran out.
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
    """Return the result of a numbered task, or the error that it raised."""
    try:
        return numbered[1]()
    except PisigmaError as refusal:
        return refusal


class RayEngine(AbstractEngine):
    """Engine that runs a function as Ray tasks of one core; all machines must see the files under the same paths."""

    def __init__(self, workers: int | None, address: str | None = None) -> None:
        """Start Ray on this machine, or join a cluster.

        Args:
            workers: number of workers on this machine; None for one per core. Ignored for a cluster.
            address: address of a cluster, such as "auto" or "ray://head:10001"; None for this machine.

        Raises:
            ImportError: Ray is not installed.
        """
        import ray

        self._ray: Any = ray  # most functions of Ray have no types
        stated = {"address": address} if address else {"num_cpus": workers}
        variables = ONE_THREAD if address else {**ONE_THREAD, "PYTHONPATH": os.pathsep.join(sys.path)}
        self._ray.init(
            log_to_driver=False, logging_level=logging.ERROR, runtime_env={"env_vars": variables}, **stated
        )
        self._workers = max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    @property
    def workers(self) -> int:
        """Number of cores of the cluster."""
        return self._workers

    def close(self) -> None:
        """Leave the cluster, or stop Ray on this machine."""
        self._ray.shutdown()

    def _chunks(
        self, work: Callable[[Item], Result], chunks: Sequence[Sequence[Item]]
    ) -> Iterator[tuple[Sequence[Item], list[Result] | None]]:
        """See `AbstractEngine`."""
        task = self._ray.remote(num_cpus=1, max_retries=0)(process_chunk)
        running = {task.remote(*pack_arguments(work, chunk)): chunk for chunk in chunks}
        while running:
            (ended,), _ = self._ray.wait(list(running), num_returns=1)
            chunk = running.pop(ended)
            try:
                yield chunk, unpack_results(self._ray.get(ended))
            except (self._ray.exceptions.WorkerCrashedError, self._ray.exceptions.OutOfMemoryError):
                yield chunk, None


COMMAND = (
    "import sys; sys.path[:] = filter(None, sys.path); "
    "from pisigma.files.engines.processes import serve_requests; serve_requests()"
)
"""Program of the process, without the working directory on the path; `PYTHONSAFEPATH` needs Python 3.11."""


class ProcessEndedError(Exception):
    """Error for a process that was ended before it returned a result."""


def compute_here(work: Callable[..., Result], progress: Progress | None = None) -> Result:
    """Compute in this process; see `BackgroundProcess.compute`."""
    return work() if progress is None else work(progress=progress)


class BackgroundProcess:
    """A process that computes one function at a time, with one thread, until it is closed."""

    def __init__(self) -> None:
        """Start the process."""
        environment, pipe = {**os.environ, **ONE_THREAD, "PYTHONSAFEPATH": "1"}, subprocess.PIPE
        command = [sys.executable, "-c", COMMAND]
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment)
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._answers = self._process.stdin, self._process.stdout
        self._lock = threading.Lock()

    def compute(self, work: Callable[..., Result], progress: Progress | None = None) -> Result:
        """Compute a function in the process, and return its result.

        Args:
            work: a function of a module, or a `functools.partial` of one; it and its result are pickled.
            progress: passed to the function as `progress`, and called here. An exception that it raises ends the
                function, and is raised.

        Raises:
            ProcessEndedError: the process was closed in the meantime, died, or was ended by an exception, such as an
                interruption, during an earlier call.
        """
        request = pickle.dumps((work, progress is not None))
        with self._lock:
            kind, pickled, stopped = self._answer(
                (loaded_plugins(), request), progress or (lambda what: None)
            )
        if stopped is not None:
            raise stopped
        value = pickle.loads(pickled)
        if kind == "error":
            raise value
        return value  # type: ignore[no-any-return]

    def close(self) -> None:
        """End the process at once, and discard its computation."""
        self._process.kill()
        self._process.wait()
        with self._lock, contextlib.suppress(OSError):
            self._answers.close()
            self._requests.close()

    def _answer(self, request: Any, progress: Progress) -> tuple[str, bytes, BaseException | None]:
        """Send a request, report progress, and return the answer and the exception that `progress` raised."""
        stopped, answered = None, False
        try:
            self._send(request)
            while (answer := self._receive())[0] == "progress":
                try:
                    progress(pickle.loads(answer[1]))
                except BaseException as problem:
                    stopped = problem
                self._send(stopped is None)
            answered = True
        finally:
            if not answered:
                self._process.kill()  # a later call would take the answer to this call for its own
        return *answer, stopped

    def _send(self, value: Any) -> None:
        try:
            self._requests.write(pickle.dumps(value))
            self._requests.flush()
        except (OSError, ValueError):
            raise self._ended() from None

    def _receive(self) -> tuple[str, bytes]:
        try:
            answer: tuple[str, bytes] = pickle.load(self._answers)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise self._ended() from None
        return answer

    def _ended(self) -> ProcessEndedError:
        status = self._process.poll()
        return ProcessEndedError(
            "the background process ended without returning a "
            f"result{'' if status is None else f' (exit status {status})'}"
        )


def serve_requests() -> None:
    """Compute the requests of the process at the other end of stdin and stdout, until that process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process handles interrupts
    if hasattr(os, "nice"):
        os.nice(10)  # computations that the user is waiting for come first
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output that functions print must not be mixed with the answers

    def answer(kind: str, pickled: bytes) -> None:
        answers.write(pickle.dumps((kind, pickled)))
        answers.flush()

    def report(what: str) -> None:
        answer("progress", pickle.dumps(what))
        if not pickle.load(requests):
            raise _StoppedError

    with contextlib.suppress(EOFError, OSError):
        while True:
            plugins, pickled = pickle.load(requests)
            try:
                plugins.load()
                work, reports = pickle.loads(pickled)
                found = "result", pickle.dumps(work(progress=report) if reports else work())
            except (Exception, _StoppedError) as problem:
                found = "error", _pickled_error(problem)
            answer(*found)


class _StoppedError(BaseException):
    """Exception that ends a computation whose result is not needed; no function may handle it as an error."""


def _pickled_error(problem: BaseException) -> bytes:
    """Return an exception as bytes, or its text if it cannot be pickled."""
    try:
        pickled = pickle.dumps(problem)
        pickle.loads(pickled)
    except Exception:
        return pickle.dumps(RuntimeError(f"{type(problem).__name__}: {problem}"))
    return pickled
