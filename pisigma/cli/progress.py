"""Progress of long commands on stderr: the current step, its number, and the time left."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import typer

from pisigma.files.errors import make_printable
from pisigma.files.progress import TimeLeft, completed_fraction, step_name

if TYPE_CHECKING:
    from rich.status import Status

QUIET_S = 2.0
"""Time [s] before a command without a terminal prints a line, and between two lines that are not numbered steps."""


@contextmanager
def progress_of(title: str) -> Iterator[Callable[[str], None]]:
    """Show the progress of a command: a line that changes on a terminal, otherwise a line per step.

    Yields:
        A function to call with the current step; numbered steps, such as "repeat 1 of 3, fold 2 of 5: series", also
        show the time left.
    """
    from rich.console import Console

    console = Console(stderr=True)
    shown = _Shown(title, console.status(make_printable(title)) if console.is_terminal else None)
    try:
        yield shown.show_step
    finally:
        shown.hide()


class _Shown:
    """Displayed progress of a command."""

    def __init__(self, title: str, status: "Status | None") -> None:
        self.title, self.status = title, status
        self.begun = self.printed = time.monotonic()
        self.left = TimeLeft()
        self.what = self.step = ""
        self.timer: threading.Timer | None = None

    def show_step(self, what: str) -> None:
        """Show the current step."""
        self.what = what
        if self.status is not None:
            from rich.text import Text

            self.status.update(Text(self._line(what)))
            self.status.start()  # started at the first step, because another progress bar may be drawn before that
            return
        self._stop_timer()
        now = time.monotonic()
        is_due = now - self.printed >= QUIET_S or (
            completed_fraction(what) is not None and now - self.begun >= QUIET_S
        )
        if step_name(what) != self.step and is_due:
            self._print()
        elif step_name(what) != self.step:
            self._line(what)  # this starts the clock of the steps
            self.timer = threading.Timer(QUIET_S - (now - self.printed), self._print)
            self.timer.daemon = True
            self.timer.start()

    def hide(self) -> None:
        """Stop showing the progress."""
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
        """Return the line of the current step, with the time left if steps are numbered."""
        return make_printable(f"{self.title}: {self.left.text_with_time_left(what)}")
