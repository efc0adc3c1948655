"""Work for engines, which other processes import."""

import os
import time

from pisigma.errors import IdentificationError


def square(number: int) -> int:
    """The square; the process of -1 ends."""
    if number == -1:
        os._exit(1)
    return number * number


def environment(name: str) -> tuple[str | None, int]:
    """A variable of the environment, and the process."""
    return os.environ.get(name), os.getpid()


def refuse(after: float) -> None:
    """Refuse after some seconds."""
    time.sleep(after)
    raise IdentificationError(f"refused after {after} s")
