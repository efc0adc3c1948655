"""A process that computes for this one, whose threads then answer at once and which can be ended at any time."""

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
    """The process was ended before it returned a result."""


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
            EndedError: the process was closed meanwhile, or died.
        """
        with self._lock:
            self._send((loaded_plugins(), pickle.dumps((work, progress is not None))))
            while (answer := self._receive())[0] == "progress":
                self._report(progress or (lambda what: None), answer[1])
        kind, value = answer
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

    def _report(self, progress: Progress, what: str) -> None:
        """Report progress; if that raises, end the function in the process first."""
        try:
            progress(what)
        except BaseException:
            self._send(False)
            self._receive()
            raise
        self._send(True)

    def _send(self, value: Any) -> None:
        try:
            pickle.dump(value, self._requests)
            self._requests.flush()
        except (OSError, ValueError):
            raise EndedError from None

    def _receive(self) -> tuple[str, Any]:
        try:
            answer: tuple[str, Any] = pickle.load(self._answers)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise EndedError from None
        return answer


def serve() -> None:
    """Compute the requests of the process at the other end of stdin and stdout, until that process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other process handles interruptions
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what functions print must not get among the answers

    def answer(kind: str, value: Any) -> None:
        answers.write(pickle.dumps((kind, value)))
        answers.flush()

    def report(what: str) -> None:
        answer("progress", what)
        if not pickle.load(requests):
            raise EndedError

    with contextlib.suppress(EOFError, OSError):
        while True:
            plugins, pickled = pickle.load(requests)
            try:
                plugins.load()
                work, reports = pickle.loads(pickled)
                found = "result", work(progress=report) if reports else work()
            except Exception as problem:
                found = "error", problem
            answer(*found)
