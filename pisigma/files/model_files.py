"""The files of a model folder, known without torch."""

import hashlib
import os
import re
from pathlib import Path

from pisigma.files.errors import ModelError
from pisigma.files.input_file import MOST_BYTES, read_input

DESCRIPTION = "model.yaml"
"""Robot, network, provenance, metrics."""
WEIGHTS = "model.safetensors"
"""All tensors."""
COMPILED = "compiled.npz"
"""The same as arrays for the compiled kernels, made from the two others; a folder is whole without it."""
DRAWING = "drawing.urdf"
"""The URDF file that the robot was drawn in, where it was."""
CARD = "README.md"
"""What people read."""
HELD_OUT_CSV = "held_out.csv"
"""Every held-out row with its errors."""
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
"""All that pisigma writes into a model folder: whatever else lies in one is somebody's work."""


_MOST = {DESCRIPTION: 2**21, WEIGHTS: 2**28, HELD_OUT_CSV: 2**28}
"""Bytes of files for which it is not `MOST_BYTES`."""

_SIGNED = re.compile(rb"(.*\n)compiled_sha256: (\S+)\nsha256: ([0-9a-f]{64})\n", re.DOTALL)


def read_model_file(folder: Path, name: str) -> bytes:
    """Read a file of a model folder.

    Raises:
        ModelError: it is missing, no regular file, larger than one of its kind can be, or cannot be read.
    """
    path = folder / name
    if path.exists() and not path.is_file():
        raise ModelError(f"{path}: is a folder, a pipe or a device, no regular file; copy the model again.")
    return read_input(path, ModelError, _MOST.get(name, MOST_BYTES))


def model_hash(folder: str | os.PathLike[str]) -> str:
    """SHA-256 of `model.yaml`, which holds those of the other files that `pisigma.load` reads.

    Raises:
        ModelError: it cannot be read.
    """
    return hashlib.sha256(read_model_file(Path(folder), DESCRIPTION)).hexdigest()


def check_model_hash(folder: str | os.PathLike[str], sha256: str) -> None:
    """Make sure that a model is the one that somebody means.

    Args:
        folder: of the model.
        sha256: wanted `model_hash`, as `sha256sum` prints it.

    Raises:
        ModelError: the model is another one, or cannot be read.
    """
    if (came := model_hash(folder)) != sha256.strip().lower():
        raise ModelError(
            f"{folder}: a model whose {DESCRIPTION} has the SHA-256 {sha256} was wanted, but it is {came}; this "
            "is another model, or it was changed."
        )


def content_hash(description: bytes, weights: bytes) -> str:
    """SHA-256 of the description, without its last two lines, and the weights: what compiled arrays are made from."""
    return hashlib.sha256(description + weights).hexdigest()


def ready_hash(folder: Path) -> str | None:
    """Give the `content_hash` of a folder whose `compiled.npz` is the one that its description states; else None."""
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
    """Whether a folder holds the description of a model, of whatever format and state.

    Raises:
        OSError: the folder cannot be looked into.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return re.match(rb"format: [0-9]", file.read(len("format: 4"))) is not None
