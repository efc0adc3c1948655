"""Write a file completely or not at all, and never replace an input or part of a model."""

import errno
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from pisigma.files.conflicts import Input, check_conflicts
from pisigma.files.errors import OutputError, Place
from pisigma.files.scratch import FILE, remove_stale_scratch, scratch_beside


def check_output(
    path: Path, suffixes: tuple[str, ...] = (), content_name: str = "", inputs: Iterable[Input] = ()
) -> None:
    """Check that an output file may be written, before the computation starts.

    Args:
        path: the file.
        suffixes: file name extensions that are allowed; () for any.
        content_name: name of the contents for messages about the extension, such as "the page".
        inputs: files and folders that the same call reads.

    Raises:
        OutputError: the path has a wrong extension, is an input, part of a model or not a regular file, or its folder
            is missing or read-only.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        endings = " or ".join(suffixes)
        problem = f"{content_name} must be written to a {endings} file"
        raise _refusal(path, problem, expected=f"a {endings} file", value=path.suffix)
    try:
        if path.is_dir():
            raise _refusal(path, "the output is a folder", expected="a file", value="a folder")
        if path.exists() and not path.is_file():
            problem = "the output is not a regular file, but a device or a pipe"
            raise _refusal(path, problem, expected="a file", value="a device or a pipe")
        if not path.parent.is_dir():
            raise OutputError(
                f"there is no folder {path.parent}",
                expected="an existing folder",
                value=str(path.parent),
                at=Place(path),
                remedy="create it or choose another --out",
            )
        if not os.access(path.parent, os.W_OK):
            problem = f"the folder {path.parent} cannot be written to"
            raise _refusal(path, problem, expected="a writable folder", value=str(path.parent))
        check_conflicts(path, inputs)
    except OSError as problem:
        raise write_failure(path, problem) from None


def _refusal(path: Path, problem: str, expected: str, value: str) -> OutputError:
    return OutputError(problem, expected=expected, value=value, at=Place(path), remedy="choose another --out")


def check_page(page: Path, inputs: Iterable[Input] = ()) -> None:
    """Check that an HTML page may be written, as `check_output` does."""
    check_output(page, (".html", ".htm"), "a page", inputs)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file next to `path` and rename it to `path` in one step; an existing file is replaced.

    Raises:
        OutputError: the path is not allowed (see `check_output`), or writing fails; no scratch file remains.
    """
    with open_atomically(path) as file:
        if isinstance(content, bytes):
            file.buffer.write(content)
        else:
            file.write(content)


@contextmanager
def open_atomically(path: Path) -> Iterator[TextIO]:
    """Open a text file next to `path` for writing and rename it to `path` at the end; an existing file is replaced.

    Nothing is left behind if the block ends with an exception or an interruption. Scratch files of killed processes
    are removed.

    Raises:
        OutputError: the path is not allowed (see `check_output`), or writing fails.
    """
    check_output(path)
    try:
        target = Path(os.path.realpath(path))
        remove_stale_scratch(target)
        with scratch_beside(target, FILE) as scratch:
            with scratch.open("w", newline="\n", encoding="utf-8", errors="backslashreplace") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            scratch.chmod(0o644)
            os.replace(scratch, target)
    except OSError as problem:
        raise write_failure(path, problem) from None


def write_failure(path: str | os.PathLike[str], problem: OSError) -> OutputError:
    """Return an `OutputError` for an output that the operating system refuses to write."""
    is_full = problem.errno in (errno.ENOSPC, errno.EDQUOT)
    return OutputError(
        f"the output cannot be written: {problem.strerror}",
        value=problem.strerror,
        at=Place(path),
        remedy="free space on its disk" if is_full else "make its folder writable or choose another --out",
    )
