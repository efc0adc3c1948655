"""How a long computation says what it is doing."""

from collections.abc import Callable

Progress = Callable[[str], None]
"""Called with what is being done, in a few words."""


def silent(what: str) -> None:
    """Say nothing, in processes that nobody listens to."""


def stage(progress: Progress, name: str, separator: str = ": ") -> Progress:
    """Give what a stage of a computation calls: the name of the stage stands before what it does."""
    return lambda what: progress(f"{name}{separator}{what}")
