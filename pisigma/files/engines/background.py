"""A process that computes for this one, so that threads of this one answer at once; it can be ended at any time."""

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from pisigma.files.engines.engine import ONE_THREAD, Result
from pisigma.files.plugins import loaded_plugins
from pisigma.files.progress import Progress

COMMAND = "from pisigma.files.engines.background import serve; serve()"


class EndedError(Exception):
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
            EndedError: the process was closed in the meantime, died, or was ended by an exception, such as an
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

    def _ended(self) -> EndedError:
        status = self._process.poll()
        return EndedError(
            "the background process ended without returning a "
            f"result{'' if status is None else f' (exit status {status})'}"
        )


def serve() -> None:
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
