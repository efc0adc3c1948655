"""Writing one text file whole or not at all."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pisigma.errors import OutputError


def check_output(path: Path, suffixes: tuple[str, ...], what: str) -> None:
    """Make sure that a file may be written: before the work, not after it.

    Args:
        path: the file.
        suffixes: endings that it may have.
        what: what the file is to hold, for the complaint.

    Raises:
        OutputError: another ending, a folder, or a folder that cannot be written to.
    """
    if path.suffix.lower() not in suffixes:
        raise OutputError(f"{path}: {what} goes into a {' or '.join(suffixes)} file; choose another --out.")
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; choose another --out.")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it or choose another --out.")
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"{path}: the folder cannot be written to; choose another --out.")


def write_whole(path: Path, content: str | bytes) -> None:
    """Write the content beside `path` and move it there in one step; what was there is replaced.

    Raises:
        OutputError: it cannot be written there; nothing is left behind.
    """
    with writing_whole(path) as file:
        if isinstance(content, bytes):
            file.buffer.write(content)
        else:
            file.write(content)


@contextmanager
def writing_whole(path: Path) -> Iterator[TextIO]:
    """A text file beside `path` to write to bit by bit, moved there at the end; what was there is replaced.

    Nothing is left behind where the block ends with an exception, an interruption among them.

    Raises:
        OutputError: it cannot be written there.
    """
    scratch = None
    try:
        handle, scratch = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(handle, "w", newline="\n", encoding="utf-8") as file:
            yield file
        os.chmod(scratch, 0o644)
        os.replace(scratch, path)
    except OSError as problem:
        raise OutputError(f"{path}: cannot be written ({problem.strerror}); choose another --out.") from None
    finally:
        if scratch:
            Path(scratch).unlink(missing_ok=True)
