"""Progress messages of long computations."""

from collections.abc import Callable
from functools import partial

Progress = Callable[[str], None]
"""Callback that receives a short description of the current step."""


def ignore_progress(what: str) -> None:
    """Ignore progress, for processes without a listener."""


def staged_progress(progress: Progress, name: str, separator: str = ": ") -> Progress:
    """Return a callback that puts the name of a stage before each message.

    It can be pickled if `progress` can, so that stages may run in other processes.
    """
    return partial(_within_stage, progress, f"{name}{separator}")


def _within_stage(progress: Progress, prefix: str, what: str) -> None:
    progress(prefix + what)
