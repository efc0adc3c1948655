"""Write a model folder completely or not at all, and never replace anything but a model."""

import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pisigma.files.conflicts import Input, check_conflicts
from pisigma.files.errors import OutputError, Place
from pisigma.files.model_files import MODEL_FILES, is_model
from pisigma.files.output_file import write_failure
from pisigma.files.scratch import ASIDE, FOLDER, KEPT, remove_stale_scratch, scratch_beside

_MAX_NEW_FOLDERS = 100
"""Largest number of nested folders that are created for a model."""


def check_folder(
    folder: str | os.PathLike[str],
    overwrite: bool,
    inputs: Iterable[Input] = (),
    names: Collection[str] = MODEL_FILES,
) -> None:
    """Check that a model may be written to a folder, before the computation starts.

    Args:
        folder: folder to write; it may be missing, empty or, with `overwrite`, a model.
        overwrite: whether an existing model may be replaced.
        inputs: files and folders that the same call reads.
        names: names of the files that may be replaced with the model.

    Raises:
        OutputError: the folder is a file, the working directory or a parent of it, conflicts with an input or another
            model (see `check_conflicts`), contains anything but a model, or a model without `overwrite`, needs too
            many new parent folders, or cannot be written to.
    """
    try:
        target = Path(os.path.realpath(folder))
        if target in (here := Path.cwd(), *here.parents):
            problem = "the output is the working directory or contains it"
            raise _refusal(folder, problem, expected="a folder that contains nothing else", value=str(here))
        parent = next(path for path in target.parents if path.exists())
        if (new := len(target.relative_to(parent).parts)) > _MAX_NEW_FOLDERS:
            problem = f"the output needs more than {_MAX_NEW_FOLDERS} nested new folders"
            raise _refusal(folder, problem, expected=f"{_MAX_NEW_FOLDERS} new folders or fewer", value=new)
        if parent == target.parent:
            remove_stale_scratch(target)
        check_conflicts(folder, inputs)
        _check_content(folder, target, overwrite, names)
        with scratch_beside(parent / target.name, FOLDER):
            pass
    except OSError as problem:
        raise write_failure(folder, problem) from None


def _check_content(
    folder: str | os.PathLike[str], target: Path, overwrite: bool, names: Collection[str]
) -> None:
    """Check that the existing contents of a folder may be replaced.

    Raises:
        OutputError: see `check_folder`.
        OSError: the folder cannot be accessed.
    """
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not is_model(target):
        raise OutputError(
            "the output already exists and is not a model folder",
            expected="a model folder",
            at=Place(folder),
            remedy="choose another --out or remove it",
        )
    others = sorted(
        entry.name for entry in target.iterdir() if entry.name not in names or not entry.is_file()
    )
    if others:
        also = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise OutputError(
            f"the output contains a model, but also '{others[0]}'{also}, which pisigma did not write",
            expected="a folder with a model only",
            value=others[0],
            at=Place(folder),
            remedy="move other files away or choose another --out",
        )
    if not overwrite:
        raise OutputError(
            "the output already contains a model",
            expected="a new or empty folder",
            at=Place(folder),
            remedy="replace it with --overwrite (overwrite=True in Python) or choose another --out",
        )


def _refusal(folder: str | os.PathLike[str], problem: str, expected: str, value: str | int) -> OutputError:
    return OutputError(
        problem, expected=expected, value=value, at=Place(folder), remedy="choose another --out"
    )


@contextmanager
def staged_folder(
    folder: str | os.PathLike[str], overwrite: bool = False, names: Collection[str] = MODEL_FILES
) -> Iterator[Path]:
    """Yield a scratch folder that becomes `folder` if the block succeeds, and is removed otherwise.

    A killed process leaves the old or the new model, never part of a model. If it is killed between the two
    renames, the old model is kept next to `folder`, and the next call restores it.

    Args:
        folder: folder to write; see `check_folder`.
        overwrite: whether an existing model may be replaced.
        names: names of the files that may be written.

    Raises:
        OutputError: see `check_folder`, or writing fails.
    """
    check_folder(folder, overwrite, names=names)
    target = Path(os.path.realpath(folder))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with scratch_beside(target, FOLDER) as scratch:
            scratch.chmod(0o755)
            yield scratch
            strange = {entry.name for entry in scratch.iterdir()} - set(names)
            assert not strange, f"{sorted(strange)} could not be replaced later; add them to MODEL_FILES"
            _check_content(folder, target, overwrite, names)  # other processes may have added files meanwhile
            _replace(scratch, target)
    except OSError as problem:
        raise write_failure(folder, problem) from None


def _replace(scratch: Path, target: Path) -> None:
    """Rename `scratch` to `target`; if that fails, restore the existing folder."""
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
