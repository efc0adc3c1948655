"""Where things are in the folder of a cell."""

import os
from pathlib import Path

from pisigma.files.errors import ModelError, Place
from pisigma.lifetime.cell.history import HISTORY, History

CELL_FILE = "cell.yaml"
PLANS, SESSIONS, MODELS = "plans", "sessions", "models"


def is_cell(path: str | os.PathLike[str]) -> bool:
    """Whether a folder is a cell."""
    return (Path(path) / CELL_FILE).is_file()


def model_folder(path: str | os.PathLike[str]) -> Path:
    """The folder of the model in use, where a path is a cell; else the path itself.

    Raises:
        ModelError: no model of the cell is in use.
    """
    if not is_cell(path):
        return Path(path)
    entry = History(Path(path) / HISTORY).in_use
    if entry is None:
        raise ModelError(
            "no model of the cell is in use",
            at=Place(path),
            remedy=f"see `pisigma status {path}` for the next step",
        )
    return Path(path) / MODELS / entry.name
