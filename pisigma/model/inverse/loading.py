"""Load model folders as corrected inverse kinematics, from their compiled arrays alone if possible."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from pisigma.files.errors import ModelError, Place
from pisigma.files.model_files import COMPILED, compiled_model_hash, model_hash
from pisigma.model.inverse.corrected_ik import CorrectedIK

if TYPE_CHECKING:  # run-time type checkers resolve the full names without these imports
    import pisigma.model.calibrated_model
    import pisigma.model.inverse.compiled_ik


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder as corrected inverse kinematics.

    Args:
        folder: folder that `pisigma calibrate` or `pisigma train` wrote.

    Raises:
        ModelError: the folder is not a complete model; the message names the faulty file.
    """
    path = Path(folder)
    kernels = _stored_kernels(path)
    if kernels is None:
        from pisigma.model.folder.model_folder import load_model

        return CorrectedIK(load_model(path))
    stated = model_hash(path)

    def read() -> "pisigma.model.calibrated_model.CalibratedModel":
        from pisigma.model.folder.model_folder import load_model

        if model_hash(path) != stated:
            raise ModelError(
                "the model has been changed since it was loaded", at=Place(path), remedy="load it again"
            )
        return load_model(path)

    return CorrectedIK._of_kernels(kernels, read)


def _stored_kernels(path: Path) -> "pisigma.model.inverse.compiled_ik.CompiledIK | None":
    """Return the compiled arrays of a model folder; None if they are missing, damaged or out of date."""
    stated = compiled_model_hash(path)
    if stated is None:
        return None
    from pisigma.model.inverse.compiled_ik import CompiledIK

    try:
        kernels = CompiledIK.load(path / COMPILED)
    except ModelError:
        return None
    return kernels if kernels.belongs_to == stated else None
