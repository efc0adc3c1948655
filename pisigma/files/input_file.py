"""Reading one file whole, within bounds on size and time."""

import os
import select
import stat

from pisigma.files.errors import PisigmaError, Place

MAX_BYTES = 2**26
"""Largest file that is read; files that people or instruments write are smaller (half a million rows, say)."""
MAX_WAIT_S = 4.0
"""Longest time that a pipe or a terminal may stay silent [s]."""
_CHUNK_BYTES = 2**20


def read_input(path: str | os.PathLike[str], error: type[PisigmaError], max_bytes: int = MAX_BYTES) -> bytes:
    """Read a file or a pipe whole, with bounds on memory and time.

    Args:
        path: the file.
        error: class of the exception to raise, so that callers can distinguish a bad recipe from a bad robot.
        max_bytes: largest size of the file; a larger one is rejected before it is read.

    Raises:
        error: the file is missing, a folder or too large, cannot be read, or is a pipe into which nothing is written.
    """
    content = bytearray()
    try:
        with open(path, "rb", buffering=0, opener=open_input) as file:
            size = os.fstat(file.fileno()).st_size
            while max(len(content), size) <= max_bytes:
                chunk = file.read(_CHUNK_BYTES)
                if not chunk:
                    return bytes(content)
                content += chunk
    except OSError as problem:
        what = f"the file cannot be read: {problem.strerror}"
        raise error(what, value=problem.strerror, at=Place(path), remedy="check the path") from None
    except ValueError:  # a NUL, or characters that the file system cannot encode
        what = "the path is not a valid file name"
        raise error(what, expected="a file name", at=Place(path), remedy="check the path") from None
    raise error(
        f"the file is larger than {max_bytes / 1e6:,.3g} MB, too large for a file of this kind",
        expected=f"{max_bytes} bytes or fewer",
        at=Place(path),
        remedy="check the path",
    )


def open_input(path: str, flags: int) -> int:
    """Open a file without blocking, as an opener for `open`, which would wait forever for a pipe without a writer.

    Raises:
        TimeoutError: the file is a pipe or a device that delivers nothing for `MAX_WAIT_S`.
    """
    handle = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        if not select.select([handle], [], [], MAX_WAIT_S)[0]:
            os.close(handle)
            raise TimeoutError(0, f"no data within {MAX_WAIT_S:g} s")
        os.set_blocking(handle, True)
    return handle


def read_text(
    path: str | os.PathLike[str], error: type[PisigmaError], kind: str, max_bytes: int = MAX_BYTES
) -> str:
    """Read a text file in UTF-8, with or without a byte order mark; see `read_input`.

    Args:
        path: the file.
        error: class of the exception to raise.
        kind: the expected format for the message, such as "YAML".
        max_bytes: largest size of the file.

    Raises:
        error: see `read_input`, or the file is not UTF-8 text; the exception names the line.
    """
    content = read_input(path, error, max_bytes)
    try:
        return content.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as problem:
        line = content[: problem.start].count(b"\n") + 1
        raise error(
            "the text is not UTF-8",
            expected="UTF-8 text",
            value=f"0x{content[problem.start]:02x}",
            at=Place(path, line),
            remedy=f"save the file as {kind} in UTF-8",
        ) from None
