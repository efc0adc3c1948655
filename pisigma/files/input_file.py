"""Reading one file whole, within bounds on size and time."""

import os
import select
import stat

from pisigma.files.errors import PisigmaError

MOST_BYTES = 2**26
"""A file that people or instruments write is smaller: half a million rows of measurements, say."""
LONGEST_WAIT = 4.0
"""[s] So long may a pipe or a terminal stay silent."""
_CHUNK = 2**20


def read_input(path: str | os.PathLike[str], error: type[PisigmaError], most: int = MOST_BYTES) -> bytes:
    """Read a file, or what comes through a pipe, without taking more memory or time than a file may.

    Args:
        path: the file.
        error: the exception to raise, so that callers can tell a bad recipe from a bad robot.
        most: bytes that the file may have; a larger one is refused before it is read.

    Raises:
        error: the file is missing, a folder, too large, cannot be read, or is a pipe into which nothing is written.
    """
    content = bytearray()
    try:
        with open(path, "rb", buffering=0, opener=open_input) as file:
            size = os.fstat(file.fileno()).st_size
            while max(len(content), size) <= most:
                chunk = file.read(_CHUNK)
                if not chunk:
                    return bytes(content)
                content += chunk
    except OSError as problem:
        raise error(f"{path}: cannot be read ({problem.strerror}); check the path.") from None
    except ValueError:  # a NUL, or letters that the file system cannot encode
        raise error(f"'{path}': cannot be the name of a file; check the path.") from None
    raise error(f"{path}: has more than {most / 1e6:,.0f} MB, which no file of its kind has; check the path.")


def open_input(path: str, flags: int) -> int:
    """Open a file for Python's `open`, which would wait for ever for somebody who writes into a pipe.

    Raises:
        TimeoutError: it is a pipe or a device from which nothing comes.
    """
    handle = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        if not select.select([handle], [], [], LONGEST_WAIT)[0]:
            os.close(handle)
            raise TimeoutError(0, f"nothing came through it in {LONGEST_WAIT:g} s")
        os.set_blocking(handle, True)
    return handle


def read_text(
    path: str | os.PathLike[str], error: type[PisigmaError], kind: str, most: int = MOST_BYTES
) -> str:
    """Read a text in UTF-8, with or without a byte order mark; see `read_input`.

    Args:
        path: the file.
        error: the exception to raise.
        kind: what was wanted, for the complaint, such as "YAML".
        most: bytes that the file may have.

    Raises:
        error: see `read_input`, or it is no UTF-8 text; the message names the line.
    """
    content = read_input(path, error, most)
    try:
        return content.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as problem:
        line = content[: problem.start].count(b"\n") + 1
        raise error(f"{path}, line {line}: is not UTF-8 text; save the file as {kind} in UTF-8.") from None
