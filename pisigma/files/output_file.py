"""Writing one file whole or not at all, and never over an input or a part of a model."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pisigma.files.conflicts import Input, check_apart
from pisigma.files.errors import OutputError
from pisigma.files.scratch import FILE, scratch_beside, sweep


def check_output(
    path: Path, suffixes: tuple[str, ...] = (), what: str = "", inputs: Iterable[Input] = ()
) -> None:
    """Make sure that a file may be written: before the work, not after it.

    Args:
        path: the file.
        suffixes: endings that it may have; () for any.
        what: what the file is to hold, for the complaint about its ending.
        inputs: files and folders that are read.

    Raises:
        OutputError: another ending, an input, a part of a model, no regular file, or a folder that cannot be written
            to.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise OutputError(f"{path}: {what} goes into a {' or '.join(suffixes)} file; choose another --out.")
    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; choose another --out.")
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: is no regular file, but a device or a pipe; choose another --out.")
        if not path.parent.is_dir():
            raise OutputError(f"{path}: there is no folder {path.parent}; make it or choose another --out.")
        if not os.access(path.parent, os.W_OK):
            raise OutputError(f"{path}: the folder cannot be written to; choose another --out.")
        check_apart(path, inputs)
    except OSError as problem:
        raise _not_writable(path, problem) from None


def check_page(page: Path, inputs: Iterable[Input] = ()) -> None:
    """Make sure that an HTML page may be written; see `check_output`."""
    check_output(page, (".html", ".htm"), "a page", inputs)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write the content beside `path` and move it there in one step; what was there is replaced.

    Raises:
        OutputError: see `check_output`, or it cannot be written; nothing is left behind.
    """
    with writing_whole(path) as file:
        if isinstance(content, bytes):
            file.buffer.write(content)
        else:
            file.write(content)


@contextmanager
def writing_whole(path: Path) -> Iterator[TextIO]:
    """A text file beside `path` to write to bit by bit, moved there at the end; what was there is replaced.

    Nothing is left behind where the block ends with an exception, an interruption among them; what a killed process
    left behind is swept.

    Raises:
        OutputError: see `check_output`, or it cannot be written.
    """
    check_output(path)
    try:
        target = Path(os.path.realpath(path))
        sweep(target)
        with scratch_beside(target, FILE) as scratch:
            with scratch.open("w", newline="\n", encoding="utf-8", errors="backslashreplace") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            scratch.chmod(0o644)
            os.replace(scratch, target)
    except OSError as problem:
        raise _not_writable(path, problem) from None


def _not_writable(path: Path, problem: OSError) -> OutputError:
    return OutputError(f"{path}: cannot be written ({problem.strerror}); choose another --out.")
