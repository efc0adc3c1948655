"""The files of a model folder, known without torch."""

import hashlib
from pathlib import Path

DESCRIPTION = "model.yaml"
"""Robot, network, provenance, metrics."""
WEIGHTS = "model.safetensors"
"""All tensors."""
COMPILED = "compiled.npz"
"""The same as arrays for the compiled kernels, made from the two others; a folder is whole without it."""
CARD = "README.md"
"""What people read."""


def folder_hash(folder: Path) -> str | None:
    """SHA-256 of description and weights one after the other; None where one cannot be read."""
    result = hashlib.sha256()
    try:
        for name in (DESCRIPTION, WEIGHTS):
            result.update((folder / name).read_bytes())
    except OSError:
        return None
    return result.hexdigest()
