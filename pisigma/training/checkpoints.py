"""Where the checkpoints of a training lie: beside the model folder that it will write."""

import shutil
from pathlib import Path


def checkpoint_folder(model_folder: Path) -> Path:
    """Folder for the checkpoints of a training that writes `model_folder`."""
    return model_folder.parent / f".{model_folder.name}.training"


def discard_checkpoints(folder: Path) -> None:
    """Remove the checkpoints of a training that is done."""
    shutil.rmtree(folder, ignore_errors=True)
