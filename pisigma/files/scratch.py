"""Scratch files and folders beside an output, which stay owned while their process lives and are swept after it died.

The owner holds a lock on its scratch (flock(2)), which the kernel lets go of when the process ends, however it ends. So
whoever gets the lock knows that nobody will finish or clear away what a kill left behind.
"""

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

FILE, FOLDER, ASIDE = ".part", ".partial", ".old"
"""Endings of scratch files, of scratch folders, and of folders that hold what is about to be replaced."""
KEPT = "model"
"""What a folder that is about to be replaced is called in its folder `ASIDE`."""


@contextmanager
def scratch_beside(target: Path, suffix: str) -> Iterator[Path]:
    """Give a fresh scratch file or folder beside `target`; what is still there in the end is removed.

    Args:
        target: what is to be written; without links.
        suffix: `FILE`, `FOLDER` or `ASIDE`.

    Raises:
        OSError: it cannot be made.
    """
    prefix = f".{target.name}."
    if suffix == FILE:
        handle, name = tempfile.mkstemp(suffix, prefix, target.parent)
        os.close(handle)
    else:
        name = tempfile.mkdtemp(suffix, prefix, target.parent)
    path = Path(name)
    with _owned(path):
        try:
            yield path
        finally:
            _remove(path)


def sweep(target: Path) -> None:
    """Remove what killed processes left beside `target`; what they had put aside comes back where `target` is gone.

    Args:
        target: what is to be written; without links.
    """
    ours = re.compile(rf"\.{re.escape(target.name)}\.[a-z0-9_]{{8}}(\{FILE}|\{FOLDER}|\{ASIDE})")
    with contextlib.suppress(OSError):  # of a folder that cannot be read, nothing can be swept
        for path in [path for path in target.parent.iterdir() if ours.fullmatch(path.name)]:
            with _owned(path) as owned:
                if owned and (path / KEPT).is_dir() and not target.exists():
                    os.replace(path / KEPT, target)
                if owned:
                    _remove(path)


@contextmanager
def _owned(path: Path) -> Iterator[bool]:
    """Hold the lock of a scratch; says whether that succeeded, which it does not where another process holds it."""
    handle = None
    with contextlib.suppress(OSError, ImportError):  # there are file systems without such locks, and Windows
        import fcntl

        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            handle = None
    try:
        yield handle is not None
    finally:
        if handle is not None:
            os.close(handle)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
