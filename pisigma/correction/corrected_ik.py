"""Corrected inverse kinematics: joint values that really reach a pose."""

import os

from pisigma.correction.model_folder import load_model
from pisigma.correction.torch_ik import TorchIK as CorrectedIK


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder as corrected inverse kinematics.

    Args:
        folder: what `pisigma train` wrote.

    Raises:
        ModelError: the folder is no whole model; the message says what is wrong with which file.
    """
    return CorrectedIK(load_model(folder))
