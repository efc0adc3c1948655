"""A calibrated arm as one file of plain arrays, which is read without torch."""

import os
import zipfile
import zlib
from typing import Any

import numpy as np

from pisigma.compiled.arrays import PARTS, Description
from pisigma.errors import ModelError

FORMAT = 1
_NAMES = ("branches", "joints", "name")


def write_description(
    file: str | os.PathLike[str], description: Description, *, branches: Any, joints: Any, name: str
) -> None:
    """Write a description, and the names that go with it, as `.npz`."""
    values = {
        f"{part}.{field}": np.asarray(value)
        for part in PARTS
        for field, value in getattr(description, part)._asdict().items()
    }
    values |= {"branches": np.array(branches), "joints": np.array(joints), "name": np.array(name)}
    with open(file, "wb") as stream:
        stated = {"format": np.array(FORMAT), "checksum": np.array(_checksum(values))}
        np.savez(stream, allow_pickle=False, **stated, **values)


def read_description(file: str | os.PathLike[str]) -> tuple[Description, dict[str, Any]]:
    """Read what `write_description` wrote: the description, and branches, joints and name by name.

    Raises:
        ModelError: the file is missing, truncated, foreign, changed or of another format.
    """
    try:
        with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
            values = {key: stored[key] for key in stored.files}
    except OSError as problem:
        raise ModelError(
            f"{file}: cannot be read ({problem.strerror or problem}); export the model again."
        ) from None
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, AttributeError, TypeError):
        raise ModelError(
            f"{file}: is truncated or no compiled model of pisigma; export the model again."
        ) from None
    stated = values.pop("format", None)
    if stated is None or stated.shape != () or int(stated) != FORMAT:
        raise ModelError(f"{file}: is no compiled model of format {FORMAT}; export the model again.")
    checksum = values.pop("checksum", None)
    wanted = {f"{part}.{field}" for part, kind in PARTS.items() for field in kind._fields} | set(_NAMES)
    if checksum is None or set(values) != wanted or int(checksum) != _checksum(values):
        raise ModelError(f"{file}: was changed or is no whole compiled model; export the model again.")
    parts = {
        part: kind(*(_plain(values[f"{part}.{field}"]) for field in kind._fields))
        for part, kind in PARTS.items()
    }
    names = {name: values[name].tolist() for name in _NAMES}
    return Description(**parts), names


def _plain(value: Any) -> Any:
    """A number as Python's, an array as it is."""
    return value.item() if value.ndim == 0 else value


def _checksum(values: dict[str, Any]) -> int:
    total = 0
    for key in sorted(values):
        value = np.ascontiguousarray(values[key])
        total = zlib.crc32(f"{key} {value.dtype.str} {value.shape}".encode(), total)
        total = zlib.crc32(value.tobytes(), total)
    return total
