"""Scratch files and folders next to an output, owned by a living process and removed after its death.

The owner holds a lock on its scratch (flock(2)), which the kernel releases when the process ends for any reason. A
process that gets the lock therefore knows that the owner was killed and that it may remove the scratch.
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
"""Suffixes of scratch files, of scratch folders, and of folders that hold the output to be replaced."""
KEPT = "model"
"""Name of the folder to be replaced, inside the folder with the suffix `ASIDE`."""


@contextmanager
def scratch_beside(target: Path, suffix: str) -> Iterator[Path]:
    """Yield a new scratch file or folder next to `target`, and remove it at the end if it still exists.

    Args:
        target: path to be written, links resolved.
        suffix: `FILE`, `FOLDER` or `ASIDE`.

    Raises:
        OSError: the scratch cannot be created.
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


def remove_stale_scratch(target: Path) -> None:
    """Remove scratch files of killed processes next to `target`, and restore `target` if it was moved away.

    Args:
        target: path to be written, links resolved.
    """
    ours = re.compile(rf"\.{re.escape(target.name)}\.[a-z0-9_]{{8}}(\{FILE}|\{FOLDER}|\{ASIDE})")
    with contextlib.suppress(OSError):  # nothing can be removed from a folder that cannot be read
        for path in [path for path in target.parent.iterdir() if ours.fullmatch(path.name)]:
            with _owned(path) as owned:
                if owned and (path / KEPT).is_dir() and not target.exists():
                    os.replace(path / KEPT, target)
                if owned:
                    _remove(path)


@contextmanager
def _owned(path: Path) -> Iterator[bool]:
    """Hold the lock of a scratch file or folder; yield whether it was obtained."""
    handle = None
    with contextlib.suppress(OSError, ImportError):  # some file systems and Windows have no such locks
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
