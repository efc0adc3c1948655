"""Writing a model folder whole or not at all, and never over anything but a model."""

import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pisigma.files.conflicts import Input, check_apart
from pisigma.files.errors import OutputError
from pisigma.files.model_files import MODEL_FILES, is_model
from pisigma.files.scratch import ASIDE, FOLDER, KEPT, scratch_beside, sweep

MOST_NEW_FOLDERS = 100
"""Folders in one another that are made for a model at most."""


def check_folder(
    folder: str | os.PathLike[str],
    overwrite: bool,
    inputs: Iterable[Input] = (),
    names: Collection[str] = MODEL_FILES,
) -> None:
    """Make sure that a model may be written to a folder: before the work, not after it.

    Args:
        folder: to write; one that is empty is taken, and one that holds a model with `overwrite`.
        overwrite: whether a model that is there may be replaced.
        inputs: files and folders that are read.
        names: of the files that may be replaced with the model.

    Raises:
        OutputError: it is a file, the working directory or above it, is, holds or lies in an input, lies in a model,
            holds anything but a model, or a model without `overwrite`; it lies too many folders deep; or it
            cannot be written to.
    """
    try:
        target = Path(os.path.realpath(folder))
        if target in (here := Path.cwd(), *here.parents):
            raise OutputError(
                f"{folder}: is the working directory, or the working directory lies in it; choose another --out."
            )
        parent = next(path for path in target.parents if path.exists())
        if len(target.relative_to(parent).parts) > MOST_NEW_FOLDERS:
            raise OutputError(
                f"{folder}: more than {MOST_NEW_FOLDERS} folders in one another would have to be made; choose another "
                "--out."
            )
        if parent == target.parent:
            sweep(target)
        check_apart(folder, inputs)
        _check_content(folder, target, overwrite, names)
        with scratch_beside(parent / target.name, FOLDER):
            pass
    except OSError as problem:
        raise _not_writable(folder, problem) from None


def _check_content(
    folder: str | os.PathLike[str], target: Path, overwrite: bool, names: Collection[str]
) -> None:
    """Refuse to replace what is there.

    Raises:
        OutputError: see `check_folder`.
        OSError: it cannot be looked at.
    """
    if target.exists() and not target.is_dir():
        raise OutputError(f"{folder}: exists and is no model folder; choose another --out or remove it.")
    if not target.is_dir() or not any(target.iterdir()):
        return
    if not is_model(target):
        raise OutputError(f"{folder}: exists and is no model folder; choose another --out or remove it.")
    others = sorted(
        entry.name for entry in target.iterdir() if entry.name not in names or not entry.is_file()
    )
    if others:
        also = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise OutputError(
            f"{folder}: holds a model, but also '{others[0]}'{also}, which pisigma does not write there; move that "
            "away or choose another --out."
        )
    if not overwrite:
        raise OutputError(
            f"{folder}: holds a model already; replace it with --overwrite (overwrite=True in Python) or choose "
            "another --out."
        )


@contextmanager
def staged_folder(
    folder: str | os.PathLike[str], overwrite: bool = False, names: Collection[str] = MODEL_FILES
) -> Iterator[Path]:
    """Give a scratch folder that becomes `folder` when the block ends well, and is removed when it does not.

    A process that is killed leaves the old model, the new one, or between two renames none under this name, but the old
    one beside it, which the next call puts back; never a part of one.

    Args:
        folder: to write; see `check_folder`.
        overwrite: whether a model that is there may be replaced.
        names: of the files that are written.

    Raises:
        OutputError: see `check_folder`, or something cannot be written.
    """
    check_folder(folder, overwrite, names=names)
    target = Path(os.path.realpath(folder))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with scratch_beside(target, FOLDER) as scratch:
            scratch.chmod(0o755)
            yield scratch
            strange = {entry.name for entry in scratch.iterdir()} - set(names)
            assert not strange, f"{sorted(strange)} could not be replaced later: name them in MODEL_FILES"
            _check_content(
                folder, target, overwrite, names
            )  # somebody may have put something there meanwhile
            _replace(scratch, target)
    except OSError as problem:
        raise _not_writable(folder, problem) from None


def _replace(scratch: Path, target: Path) -> None:
    """Put `scratch` where `target` is; what was there comes back when that fails."""
    if not target.exists():
        os.replace(scratch, target)
        return
    with scratch_beside(target, ASIDE) as aside:
        os.replace(target, aside / KEPT)
        try:
            os.replace(scratch, target)
        except BaseException:
            os.replace(aside / KEPT, target)
            raise


def _not_writable(folder: str | os.PathLike[str], problem: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be written ({problem.strerror}); choose another --out.")
