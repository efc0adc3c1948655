"""The running step, of which there is only one at a time: its progress, who started it, and a way to stop it."""

import datetime
import sys
import threading
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pisigma.files.errors import missing_extra, system_problem_text
from pisigma.files.progress import Progress, TimeLeft
from pisigma.reporting.result_text import ResultText


class StoppedError(Exception):
    """A person stopped the step."""


class BusyError(Exception):
    """Another step is running."""


@dataclass(frozen=True)
class Outcome:
    """Result of a step.

    Attributes:
        text: the result for people; None if the step was refused.
        refusal: reason why the input was refused or the result is not accepted.
        wrong_rows_by_sentence: wrong rows (file and line), by the sentences of the findings that name them.
        refused_field: field of the form that causes the refusal; "" if no field does.
        subject: object of the step, such as a session; "" if the step implies it.
        accuracy_curve: expected accuracy by number of poses; () without a curve.
        stopped: whether a person stopped it.
        step: name of the step.
        command: command line that has the same effect.
        started_by: who started the step.
        end_time: day and time at which the step ended.
    """

    text: ResultText | None = None
    refusal: str = ""
    wrong_rows_by_sentence: Mapping[str, str] = field(default_factory=dict)
    refused_field: str = ""
    subject: str = ""
    accuracy_curve: tuple[Any, ...] = ()
    stopped: bool = False
    step: str = ""
    command: str = ""
    started_by: str = ""
    end_time: str = ""


Work = Callable[[Progress], Outcome]


@dataclass
class Job:
    """A step while it runs.

    Attributes:
        step: name of the step.
        started_by: who started the step.
        command: command line that has the same effect.
        activity: the current activity, with the time left.
        stopped_by: name of the person who asked to stop the step; "" if nobody did.
    """

    step: str
    started_by: str
    command: str
    activity: str = ""
    stopped_by: str = ""
    start_time: str = field(default_factory=lambda: _clock())
    time_left: TimeLeft = field(default_factory=TimeLeft)

    def progress(self, message: str) -> None:
        """Record the current activity, or end the step if a person stopped it.

        Raises:
            StoppedError: a person stopped the step.
        """
        if self.stopped_by:
            raise StoppedError
        self.activity = self.time_left.text_with_time_left(message)


class Jobs:
    """The steps of a page.

    Attributes:
        running: the running step; None if no step runs.
        outcomes: the last outcome of every step.
        version: number of changes, by which pages detect changes.
        ended: number of steps that have ended.
    """

    def __init__(self) -> None:
        self.running: Job | None = None
        self.outcomes: dict[str, Outcome] = {}
        self.version = self.ended = 0
        self._lock, self._thread, self._closed = threading.Lock(), threading.Thread(), False

    def start(self, step: str, person: str, command: str, work: Work) -> None:
        """Start a step in a thread.

        Raises:
            BusyError: another step is running, or the server is ending.
        """
        with self._lock:
            if self.running is not None or self._closed:
                raise BusyError
            self.running = job = Job(step, person, command)
            self._thread = threading.Thread(target=self._run, args=(job, work), daemon=True)
            self._thread.start()
            self.version += 1

    def state(self) -> tuple[Job | None, int, int]:
        """Return the running step, `version` and `ended` at the same moment, so that they are consistent."""
        with self._lock:
            return self.running, self.version, self.ended

    def stop(self, person: str, ended_step_count: str) -> None:
        """Stop the running step when it next reports progress; no incomplete files are left.

        Args:
            person: who stops the step.
            ended_step_count: number of steps that had ended when the person decided; a later step is not stopped.
        """
        with self._lock:
            if self.running is not None and ended_step_count == str(self.ended):
                self.running.stopped_by = person
                self.version += 1

    def close(self) -> None:
        """Stop the running step, and wait until it has ended."""
        with self._lock:
            self._closed = True
        self.stop("the end of the server", str(self.ended))
        if self._thread.is_alive():
            self._thread.join()

    def _run(self, job: Job, work: Work) -> None:
        try:
            found = work(job.progress)
        except StoppedError:
            found = Outcome(
                refusal=f"stopped by {job.stopped_by}; nothing was left half written.", stopped=True
            )
        except ImportError as problem:
            found = Outcome(refusal=str(missing_extra(problem) or problem))
        except Exception as problem:
            if not (fault := system_problem_text(problem)):
                traceback.print_exc(file=sys.stderr)
            found = Outcome(
                refusal=fault
                or f"a defect in pisigma ended the step ({type(problem).__name__}: {problem}). Nothing was left "
                "half written. Please report it with the last lines of the terminal."
            )
        with self._lock:
            self.outcomes[job.step] = replace(
                found, step=job.step, command=job.command, started_by=job.started_by, end_time=_clock()
            )
            self.running = None
            self.version, self.ended = self.version + 1, self.ended + 1


def _clock() -> str:
    return datetime.datetime.now().strftime("%Y-%m-%d %H:%M")
