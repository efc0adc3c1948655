"""The files of a model folder, known without torch."""

import hashlib
import re
from pathlib import Path

DESCRIPTION = "model.yaml"
"""Robot, network, provenance, metrics."""
WEIGHTS = "model.safetensors"
"""All tensors."""
COMPILED = "compiled.npz"
"""The same as arrays for the compiled kernels, made from the two others; a folder is whole without it."""
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


def folder_hash(folder: Path) -> str | None:
    """SHA-256 of description and weights one after the other; None where one cannot be read."""
    result = hashlib.sha256()
    try:
        for name in (DESCRIPTION, WEIGHTS):
            result.update((folder / name).read_bytes())
    except OSError:
        return None
    return result.hexdigest()


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
