"""Where the checkpoints of a training lie, and whether one may be resumed."""

import pickle
import shutil
from pathlib import Path

import torch

from pisigma.errors import OutputError, TrainingError

LAST_CHECKPOINT = "last.ckpt"
FINGERPRINT = "pisigma_fingerprint"


def checkpoint_folder(model_folder: Path) -> Path:
    """Folder for the checkpoints of a training that writes `model_folder`, beside it."""
    return model_folder.parent / f".{model_folder.name}.training"


def prepare_checkpoints(folder: Path) -> None:
    """Make the folder, and remove what an earlier training left there.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LAST_CHECKPOINT).unlink(missing_ok=True)
    except OSError as problem:
        raise OutputError(
            f"{folder}: cannot be written ({problem.strerror}); choose another --out."
        ) from None


def find_checkpoint(folder: Path, fingerprint: str) -> tuple[Path, int]:
    """The checkpoint to go on from, and the number of epochs that it has seen.

    Raises:
        TrainingError: there is none, it is damaged, or it is of another recipe or other data.
    """
    path = folder / LAST_CHECKPOINT
    if not path.is_file():
        raise TrainingError(f"{folder}: there is no interrupted training to resume; run without --resume.")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        epochs, found = int(state["epoch"]) + 1, state[FINGERPRINT]
    except (OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError, pickle.UnpicklingError):
        raise TrainingError(f"{path}: is no whole checkpoint of pisigma; run without --resume.") from None
    if found != fingerprint:
        raise TrainingError(
            f"{folder}: the interrupted training there is of another recipe or other data; "
            "run without --resume to start afresh, or choose another --out."
        )
    return path, epochs


def discard_checkpoints(folder: Path) -> None:
    """Remove the checkpoints of a training that is done."""
    shutil.rmtree(folder, ignore_errors=True)
