"""New names for outputs of a cell; sessions and models are written even if other processes write there too."""

import datetime
import os
from collections.abc import Callable, Collection
from pathlib import Path

from pisigma.files.errors import OutputError, Place
from pisigma.files.scratch import FILE, scratch_beside

_MAX_NAMES = 10_000
"""Largest number of files with the same date in a folder."""


def free_path(folder: Path, name: str, suffix: str, taken_names: Collection[str] = ()) -> Path:
    """Return a path in a folder that is not taken: NAME, NAME-2, NAME-3 and so on.

    Raises:
        OutputError: all names are taken.
    """
    for number in range(1, _MAX_NAMES):
        stem = name if number == 1 else f"{name}-{number}"
        path = folder / f"{stem}{suffix}"
        if not path.exists() and stem not in taken_names:
            return path
    raise OutputError(
        f"the folder already contains {_MAX_NAMES:,} files named after {name}", at=Place(folder)
    )


def output_path(cell: str | os.PathLike[str], subfolder: str, suffix: str) -> Path:
    """Return a new path in a folder of a cell, named after today's date; the folder is created.

    Args:
        cell: folder of the cell.
        subfolder: `EXPORTS` or `REPORTS`.
        suffix: suffix of the file; "" for a folder.

    Raises:
        OutputError: the folder cannot be created.
    """
    folder = Path(cell) / subfolder
    try:
        folder.mkdir(exist_ok=True)
    except OSError as problem:
        raise OutputError(f"the folder cannot be created: {problem.strerror}", at=Place(folder)) from None
    return free_path(folder, datetime.date.today().isoformat(), suffix)


def save_under_new_name(folder: Path, save: Callable[[Path], object], taken_names: Collection[str]) -> Path:
    """Save a model under a new name, today's date, even if other processes save models in the same folder.

    Args:
        folder: folder of the models.
        save: function that writes the folder of the model, and refuses an existing folder.
        taken_names: other names that are taken, such as names of models whose folders were removed.

    Raises:
        OutputError: the model cannot be written.
    """
    while True:
        path = free_path(folder, datetime.date.today().isoformat(), "", taken_names)
        try:
            save(path)
            return path
        except OutputError:
            if not path.exists():  # otherwise another process took the name
                raise


def write_under_new_name(folder: Path, name: str, content: bytes, taken_names: Collection[str]) -> Path:
    """Write a session with a new name, completely or not at all, even if other processes write to the folder.

    Args:
        folder: folder of the sessions.
        name: name of the file without ".csv"; see `free_path`.
        content: content of the file.
        taken_names: other names that are taken.

    Raises:
        OutputError: the file cannot be written.
    """
    while True:
        path = free_path(folder, name, ".csv", taken_names)
        try:
            with scratch_beside(path, FILE) as scratch:
                with scratch.open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())
                scratch.chmod(0o644)
                os.link(
                    scratch, path
                )  # unlike a rename, this never replaces a file that another process wrote
            return path
        except FileExistsError:
            continue
        except OSError as problem:
            raise OutputError(f"the session cannot be written: {problem.strerror}", at=Place(path)) from None
