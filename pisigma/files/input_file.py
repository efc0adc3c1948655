"""Read whole files, with limits on size and waiting time."""

import os
import select
import stat

from pisigma.files.errors import PisigmaError, Place

MAX_BYTES = 2**26
"""Largest size of an input file [bytes], about half a million rows; files written by people or instruments are
smaller."""
MAX_WAIT_S = 4.0
"""Longest time that a pipe or a terminal may stay silent [s]."""
_CHUNK_BYTES = 2**20


def read_input(path: str | os.PathLike[str], error: type[PisigmaError], max_bytes: int = MAX_BYTES) -> bytes:
    """Return all bytes of a file or a pipe, with limits on memory and time.

    Args:
        path: the file.
        error: class of the exception to raise, such as `RecipeError`.
        max_bytes: largest size of the file [bytes]; a larger file is rejected before it is read.

    Raises:
        error: the file is missing, is a folder, is too large or cannot be read, or nothing is written to the pipe.
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
    except ValueError:  # the name has a NUL, or characters that the file system cannot encode
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
    """Return the text of a UTF-8 file, with or without a byte order mark, within the limits of `read_input`.

    Args:
        path: the file.
        error: class of the exception to raise.
        kind: name of the expected format for messages, such as "YAML".
        max_bytes: largest size of the file [bytes].

    Raises:
        error: the file cannot be read (see `read_input`) or is not UTF-8 text; the exception names the line.
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
