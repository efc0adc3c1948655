"""What a command is doing, on stderr."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_of(title: str) -> Iterator[Callable[[str], None]]:
    """Show a line that changes; gives what to call with what is being done now."""
    from rich.console import Console

    with Console(stderr=True).status(title) as status:
        yield lambda what: status.update(f"{title}: {what}")
