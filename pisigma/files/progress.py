"""How a long computation says what it is doing."""

from collections.abc import Callable
from functools import partial

Progress = Callable[[str], None]
"""Called with what is being done, in a few words."""


def silent(what: str) -> None:
    """Say nothing, in processes that nobody listens to."""


def stage(progress: Progress, name: str, separator: str = ": ") -> Progress:
    """Give what a stage of a computation calls: the name of the stage stands before what it does.

    It can be pickled where `progress` can, so that stages go to other processes too.
    """
    return partial(_within_stage, progress, f"{name}{separator}")


def _within_stage(progress: Progress, prefix: str, what: str) -> None:
    progress(prefix + what)
