"""Writing a model folder whole or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pisigma.errors import OutputError
from pisigma.files.model_files import DESCRIPTION


def check_replaceable(folder: str | os.PathLike[str]) -> None:
    """Make sure that a model may be written to a folder: before the work, not after it.

    Raises:
        OutputError: it is a file, a folder that holds something that is no model, or cannot be written to.
    """
    target = Path(os.path.realpath(folder))
    try:
        model = (target / DESCRIPTION).is_file()
        if target.exists() and (not target.is_dir() or (any(target.iterdir()) and not model)):
            raise OutputError(f"{folder}: exists and is no model folder; choose another --out or remove it.")
        parent = next(place for place in target.parents if place.exists())
        Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=parent)).rmdir()
    except OSError as problem:
        raise _not_writable(folder, problem) from None


@contextmanager
def staged_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a scratch folder that becomes `folder` when the block ends well, and is removed when it does not.

    A model folder that is there already is replaced; any other folder or file is not touched. A process that
    is killed leaves the old model, the new one, or between two renames none under this name; never a part of
    one.

    Raises:
        OutputError: `folder` is a file, or a folder that holds no model, or something cannot be written.
    """
    check_replaceable(folder)
    target = Path(os.path.realpath(folder))
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".partial", dir=target.parent))
    except OSError as problem:
        raise _not_writable(folder, problem) from None
    try:
        scratch.chmod(0o755)
        yield scratch
        _replace(scratch, target)
    except OSError as problem:
        raise _not_writable(folder, problem) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _replace(scratch: Path, target: Path) -> None:
    """Put `scratch` in the place of `target`; what was there comes back when that fails."""
    if not target.exists():
        os.replace(scratch, target)
        return
    aside = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".old", dir=target.parent))
    try:
        os.replace(target, aside / "model")
        try:
            os.replace(scratch, target)
        except BaseException:
            os.replace(aside / "model", target)
            raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _not_writable(folder: str | os.PathLike[str], problem: OSError) -> OutputError:
    return OutputError(f"{folder}: cannot be written ({problem.strerror}); choose another --out.")
