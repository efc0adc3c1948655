"""Names and hashes of the files of a model folder, without importing torch."""

import hashlib
import os
import re
from pathlib import Path

from pisigma.files.errors import ModelError, Place
from pisigma.files.input_file import MAX_BYTES, read_input

DESCRIPTION = "model.yaml"
"""File with the description of a model: robot, network, provenance and metrics."""
WEIGHTS = "model.safetensors"
"""File with all tensors of a model."""
COMPILED = "compiled.npz"
"""Optional file with the arrays for the compiled kernels, made from `model.yaml` and `model.safetensors`."""
DRAWING = "drawing.urdf"
"""URDF file of the nominal robot, if the robot was read from one."""
CARD = "README.md"
"""File with the model card."""
HELD_OUT_CSV = "held_out.csv"
"""File with all held-out rows and their errors."""
PARAMETERS_CSV = "parameters.csv"
CORRELATION_CSV = "correlation.csv"
ENERGY_CSV = "energy.csv"
ENERGY_PNG = "energy.png"
WORKSPACE_PNG = "errors_over_workspace.png"
RESIDUALS_PNG = "residuals.png"
HELD_OUT_PNG = "held_out_errors.png"
CORRELATION_PNG = "correlation.png"
CORRECTIONS_PNG = "joint_corrections.png"
CURVE_PNG = "learning_curve.png"
SPREAD_PNG = "predicted_spread.png"

MODEL_FILES = frozenset(
    value for name, value in list(globals().items()) if name.isupper() and isinstance(value, str)
)
"""All files that pisigma writes into a model folder; all other files belong to the user."""


_MAX_BYTES = {DESCRIPTION: 2**21, WEIGHTS: 2**28, HELD_OUT_CSV: 2**28}
"""Largest sizes [bytes] of files whose limit is not `MAX_BYTES`."""

_WEIGHTS_HASH = re.compile(rb"^weights_sha256: ['\"]?([0-9a-f]{64})", re.MULTILINE)
_SIGNED = re.compile(rb"(.*\n)compiled_sha256: (\S+)\nsha256: ([0-9a-f]{64})\n", re.DOTALL)


def read_model_file(folder: Path, name: str) -> bytes:
    """Return the bytes of a file in a model folder.

    Raises:
        ModelError: the file is missing, not a regular file, too large, or cannot be read.
    """
    path = folder / name
    if path.exists() and not path.is_file():
        problem = "the path is a folder, a pipe or a device"
        raise ModelError(problem, expected="a regular file", at=Place(path), remedy="copy the model again")
    return read_input(path, ModelError, _MAX_BYTES.get(name, MAX_BYTES))


def model_hash(folder: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of `model.yaml`, which contains the hashes of the other files that `pisigma.load` reads.

    Raises:
        ModelError: the file cannot be read.
    """
    return hashlib.sha256(read_model_file(Path(folder), DESCRIPTION)).hexdigest()


def is_unchanged(folder: Path, sha256: str) -> bool:
    """Return whether the description and the weights of a model have the given `model_hash`."""
    try:
        description, weights = (read_model_file(folder, name) for name in (DESCRIPTION, WEIGHTS))
    except ModelError:
        return False
    stated = _WEIGHTS_HASH.search(description)
    same = stated is None or hashlib.sha256(weights).hexdigest().encode() == stated[1]
    return same and hashlib.sha256(description).hexdigest() == sha256


def check_model_hash(folder: str | os.PathLike[str], sha256: str) -> None:
    """Check that a model is the expected one.

    Args:
        folder: folder of the model.
        sha256: the expected `model_hash`, as `sha256sum` prints it.

    Raises:
        ModelError: the model is a different one, has been changed, or cannot be read.
    """
    if (actual := model_hash(folder)) != sha256.strip().lower():
        raise ModelError(
            f"expected a model whose {DESCRIPTION} has the SHA-256 {sha256}, got {actual}",
            expected=sha256,
            value=actual,
            at=Place(folder),
            remedy="check that this is the intended model and was not changed",
        )


def content_hash(description: bytes, weights: bytes) -> str:
    """Return the SHA-256 of a description, without its last two lines, and of the weights, as in `compiled.npz`."""
    return hashlib.sha256(description + weights).hexdigest()


def compiled_model_hash(folder: Path) -> str | None:
    """Return the `content_hash` of a folder if its `compiled.npz` has the hash in the description, otherwise None."""
    try:
        description, weights, compiled = (
            read_model_file(folder, name) for name in (DESCRIPTION, WEIGHTS, COMPILED)
        )
    except ModelError:
        return None
    signed = _SIGNED.fullmatch(description)
    if signed is None or hashlib.sha256(compiled).hexdigest().encode() != signed[2]:
        return None
    return content_hash(signed[1], weights)


def is_model(folder: Path) -> bool:
    """Return whether a folder contains the description of a model, even in another format version or damaged.

    Raises:
        OSError: the folder cannot be accessed.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return re.match(rb"format: [0-9]", file.read(len("format: 4"))) is not None
