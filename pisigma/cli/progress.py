"""Progress of long commands on stderr: what is being done, which step of how many, and the time left."""

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from pisigma.files.errors import printable

if TYPE_CHECKING:
    from rich.status import Status

QUIET_S = 2.0
"""Time [s] for which a command without a terminal says nothing, and between two lines that are not numbered steps."""

_STEP = re.compile(r"\b[a-z]+ (\d[\d,]*) of (\d+(?:,\d+)*)")
"""A numbered step, such as "fold 2 of 5"."""


@contextmanager
def progress_of(title: str) -> Iterator[Callable[[str], None]]:
    """Show what a command is doing: a line that changes on a terminal, otherwise a line per step.

    Yields:
        What to call with what is being done now; numbered steps, such as "repeat 1 of 3, fold 2 of 5: series", also
        show the time left.
    """
    from rich.console import Console

    console = Console(stderr=True)
    shown = _Shown(title, console.status(printable(title)) if console.is_terminal else None)
    try:
        yield shown.show_step
    finally:
        shown.hide()


def share_done(what: str) -> float | None:
    """Return the share of nested steps that are done: 0.1 of "half 1 of 2, fold 2 of 5"; None without a step."""
    steps = [tuple(int(number.replace(",", "")) for number in one) for one in _STEP.findall(what)]
    share, width = 0.0, 1.0
    for number, count in steps:
        width /= max(count, 1)
        share += (number - 1) * width
    return share if steps else None


def step_name(what: str) -> str:
    """Return the step of what is being done, without its details."""
    last = max((match.end() for match in _STEP.finditer(what)), default=0)
    return what[:last] if last else what.partition(": ")[0]


class _Shown:
    """What is shown of a command."""

    def __init__(self, title: str, status: "Status | None") -> None:
        self.title, self.status = title, status
        self.begun = self.printed = time.monotonic()
        self.first: tuple[float, float] | None = None
        self.last = 0.0
        self.what = self.step = ""
        self.timer: threading.Timer | None = None

    def show_step(self, what: str) -> None:
        """Show what is being done now."""
        self.what = what
        if self.status is not None:
            from rich.text import Text

            self.status.update(Text(self._line(what)))
            self.status.start()  # not before there is something to show: another bar may be drawn until then
            return
        self._stop_timer()
        now = time.monotonic()
        is_due = now - self.printed >= QUIET_S or (
            share_done(what) is not None and now - self.begun >= QUIET_S
        )
        if step_name(what) != self.step and is_due:
            self._print()
        elif step_name(what) != self.step:
            self._line(what)  # which starts the clock of the steps
            self.timer = threading.Timer(QUIET_S - (now - self.printed), self._print)
            self.timer.daemon = True
            self.timer.start()

    def hide(self) -> None:
        """Stop showing it."""
        self._stop_timer()
        if self.status is not None:
            self.status.stop()

    def _stop_timer(self) -> None:
        if self.timer is not None:
            self.timer.cancel()
            self.timer = None

    def _print(self) -> None:
        self.printed, self.step = time.monotonic(), step_name(self.what)
        typer.echo(self._line(self.step), err=True)

    def _line(self, what: str) -> str:
        """Write what is being done, with the time left where steps are numbered."""
        share, now = share_done(what), time.monotonic()
        left = ""
        if share is None:
            return printable(f"{self.title}: {what}")
        if self.first is None or share < self.last:  # the first steps, or those of another stage
            self.first = (share, now)
        elif share > self.first[0]:
            begun, since = self.first
            left = f", about {_duration((now - since) * (1 - share) / (share - begun))} left"
        self.last = share
        return printable(f"{self.title}: {what}{left}")


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
