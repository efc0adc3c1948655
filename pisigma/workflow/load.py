"""Load corrected inverse kinematics from a model folder, or from a cell with the model that is in use there."""

import os

from pisigma.lifetime.cell.layout import model_folder
from pisigma.model.inverse.corrected_ik import CorrectedIK
from pisigma.model.inverse.corrected_ik import load as load_folder


def load(folder: str | os.PathLike[str]) -> CorrectedIK:
    """Load a model folder, or the model in use of a cell, as corrected inverse kinematics.

    Args:
        folder: what `pisigma calibrate`, `pisigma train` or `pisigma new` wrote.

    Raises:
        ModelError: the folder does not hold a whole model (the message says what is wrong with which file), or no
            model of the cell is in use.
    """
    return load_folder(model_folder(folder))
