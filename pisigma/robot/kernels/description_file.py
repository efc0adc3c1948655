"""A calibrated arm as one file of plain arrays, which is read without torch."""

import dataclasses
import json
import math
import os
import zipfile
import zlib
from typing import Any

import numpy as np

from pisigma.files.errors import ModelError
from pisigma.robot.kernels.arrays import PARTS, Description
from pisigma.robot.kernels.forms import KernelForms

FORMAT = 6
_NAMES = ("branches", "joints", "name", "belongs_to")
_FIELDS = [(part, field) for part, kind in PARTS.items() for field in kind._fields]


def write_description(
    file: str | os.PathLike[str],
    description: Description,
    *,
    branches: Any,
    joints: Any,
    name: str,
    belongs_to: str = "",
) -> None:
    """Write a description, and the names that go with it, as `.npz`; see `CompiledIK` for these.

    All numbers stand in two rows, because every array in the file costs a new process time to read.
    """
    shapes: dict[str, tuple[str, tuple[int, ...]]] = {}
    rows: dict[str, list[Any]] = {"floats": [], "integers": []}
    for part, field in _FIELDS:
        value = np.asarray(getattr(getattr(description, part), field))
        kind = "integers" if value.dtype.kind == "i" else "floats"
        shapes[f"{part}.{field}"] = (kind, value.shape)
        rows[kind].append(value.ravel())
    stated = {
        "branches": branches,
        "joints": joints,
        "name": name,
        "belongs_to": belongs_to,
        "forms": dataclasses.asdict(description.forms),
        "shapes": shapes,
    }
    values = {
        "header": np.array(json.dumps(stated)),
        "floats": np.concatenate(rows["floats"]).astype(np.float64),
        "integers": np.concatenate(rows["integers"]).astype(np.int64),
    }
    with open(file, "wb") as stream:
        checks = {"format": np.array(FORMAT), "checksum": np.array(_checksum(values))}
        np.savez(stream, allow_pickle=False, **checks, **values)


def read_description(file: str | os.PathLike[str]) -> tuple[Description, dict[str, Any]]:
    """Read what `write_description` wrote: the description, and the names by what they are of.

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
    if (
        checksum is None
        or set(values) != {"header", "floats", "integers"}
        or int(checksum) != _checksum(values)
    ):
        raise ModelError(f"{file}: was changed or is no whole compiled model; export the model again.")
    header = json.loads(str(values["header"]))
    description = _description(header["shapes"], values)
    forms = KernelForms(**{kind: tuple(names) for kind, names in header["forms"].items()})
    return description._replace(forms=forms), {name: header[name] for name in _NAMES}


def _description(shapes: dict[str, Any], values: dict[str, Any]) -> Description:
    """Cut the two rows of numbers into fields; a single number becomes Python's."""
    taken = {"floats": 0, "integers": 0}
    parts: dict[str, dict[str, Any]] = {part: {} for part in PARTS}
    for part, field in _FIELDS:
        kind, shape = shapes[f"{part}.{field}"]
        start = taken[kind]
        taken[kind] = start + math.prod(shape)
        numbers = values[kind][start : taken[kind]]
        parts[part][field] = numbers.reshape(shape) if shape else numbers.item()
    return Description(**{part: PARTS[part](**fields) for part, fields in parts.items()})


def _checksum(values: dict[str, Any]) -> int:
    total = 0
    for key in sorted(values):
        value = np.ascontiguousarray(values[key])
        total = zlib.crc32(f"{key} {value.dtype.str} {value.shape}".encode(), total)
        total = zlib.crc32(value.tobytes(), total)
    return total
