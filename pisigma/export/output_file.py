"""Writing one text file whole or not at all."""

import os
import tempfile
from pathlib import Path

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


def write_whole(path: Path, text: str) -> None:
    """Write the text beside `path` and move it there in one step; what was there is replaced.

    Raises:
        OutputError: it cannot be written there; nothing is left behind.
    """
    scratch = None
    try:
        handle, scratch = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        with os.fdopen(handle, "w", newline="\n", encoding="utf-8") as file:
            file.write(text)
        os.chmod(scratch, 0o644)
        os.replace(scratch, path)
    except OSError as problem:
        raise OutputError(f"{path}: cannot be written ({problem.strerror}); choose another --out.") from None
    finally:
        if scratch:
            Path(scratch).unlink(missing_ok=True)
