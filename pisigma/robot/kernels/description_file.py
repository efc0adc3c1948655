"""Read and write calibrated arms as files of plain arrays, without torch."""

import dataclasses
import json
import math
import os
import zipfile
import zlib
from typing import Any

import numpy as np

from pisigma.files.errors import ModelError, Place
from pisigma.robot.kernels.arrays import PARTS, Description
from pisigma.robot.kernels.forms import KernelForms

FORMAT = 7
_NAMES = ("branches", "joints", "name", "belongs_to", "warnings")
_FIELDS = [(part, field) for part, kind in PARTS.items() for field in kind._fields]


def write_description(
    file: str | os.PathLike[str],
    description: Description,
    *,
    branches: Any,
    joints: Any,
    name: str,
    model_folder_hash: str = "",
    warnings: Any = (),
) -> None:
    """Write a description, names of branches, joints and model, and warnings, as `.npz`; see `CompiledIK`.

    All numbers are in two arrays, because reading many arrays takes a new process more time.
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
        "belongs_to": model_folder_hash,
        "warnings": warnings,
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
    """Return the description in a file of `write_description`, and the names and warnings by kind.

    Raises:
        ModelError: the file is missing, truncated, foreign, changed or has another format.
    """
    remedy = "export the model again"
    try:
        with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as stored:
            values = {key: stored[key] for key in stored.files}
    except OSError as problem:
        reason = str(problem.strerror or problem)
        what = f"the file cannot be read: {reason}"
        raise ModelError(what, value=reason, at=Place(file), remedy=remedy) from None
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, AttributeError, TypeError):
        expected = "a complete compiled model of pisigma"
        raise ModelError(expected=expected, at=Place(file), remedy=remedy) from None
    stated = values.pop("format", None)
    if stated is None or stated.shape != () or int(stated) != FORMAT:
        value = None if stated is None else str(stated)
        raise ModelError(expected=f"format {FORMAT}", value=value, at=Place(file), remedy=remedy)
    checksum = values.pop("checksum", None)
    if (
        checksum is None
        or set(values) != {"header", "floats", "integers"}
        or int(checksum) != _checksum(values)
    ):
        what, expected = "the file was changed or is incomplete", "a matching checksum"
        raise ModelError(what, expected=expected, at=Place(file), remedy=remedy)
    header = json.loads(str(values["header"]))
    description = _description(header["shapes"], values)
    forms = KernelForms(**{kind: tuple(names) for kind, names in header["forms"].items()})
    return description._replace(forms=forms), {name: header[name] for name in _NAMES}


def _description(shapes: dict[str, Any], values: dict[str, Any]) -> Description:
    """Return a description whose fields are parts of the two arrays; single numbers become Python numbers."""
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
