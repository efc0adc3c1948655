"""Progress messages of long computations."""

import re
import time
from collections.abc import Callable
from functools import partial

Progress = Callable[[str], None]
"""Callback that receives a short description of the current step."""


def no_progress(message: str) -> None:
    """Ignore a progress message; the default callback."""


def with_stage(progress: Progress, name: str, separator: str = ": ") -> Progress:
    """Return a callback that puts the name of a stage before each message.

    It can be pickled if `progress` can, so that stages may run in other processes.
    """
    return partial(_within_stage, progress, f"{name}{separator}")


def _within_stage(progress: Progress, prefix: str, what: str) -> None:
    progress(prefix + what)


_STEP = re.compile(r"\b[a-z]+ (\d[\d,]*) of (\d+(?:,\d+)*)")
"""Pattern of a numbered step, such as "fold 2 of 5"."""


def completed_fraction(message: str) -> float | None:
    """Return the share of nested steps that are complete: 0.1 for "half 1 of 2, fold 2 of 5"; None without steps."""
    steps = [tuple(int(number.replace(",", "")) for number in one) for one in _STEP.findall(message)]
    share, width = 0.0, 1.0
    for number, count in steps:
        width /= max(count, 1)
        share += (number - 1) * width
    return share if steps else None


def step_name(message: str) -> str:
    """Return the name of the current step without its details."""
    last = max((match.end() for match in _STEP.finditer(message)), default=0)
    return message[:last] if last else message.partition(": ")[0]


class TimeLeft:
    """Estimate the time left of a computation with numbered steps."""

    def __init__(self) -> None:
        self._first: tuple[float, float] | None = None
        self._last = 0.0

    def text_with_time_left(self, message: str) -> str:
        """Return the text of the current step, with the estimated time left if the steps are numbered."""
        share, now = completed_fraction(message), time.monotonic()
        if share is None:
            return message
        left = ""
        if self._first is None or share < self._last:  # the first step of a stage
            self._first = (share, now)
        elif share > self._first[0]:
            begun, since = self._first
            left = f", about {_duration((now - since) * (1 - share) / (share - begun))} left"
        self._last = share
        return f"{message}{left}"


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
