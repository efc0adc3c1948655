"""Writing checkpoints during a training, each whole or not at all."""

import os
from pathlib import Path
from typing import Any

import lightning

from pisigma.training.checkpoints import LAST_CHECKPOINT

CHECKPOINTS = 20
"""How often a whole training is saved."""


class CheckpointWriter(lightning.Callback):
    """Saves the training at even distances.

    Lightning's `ModelCheckpoint` saves nothing where no optimiser steps, and Levenberg-Marquardt has no
    optimiser.
    """

    def __init__(self, folder: Path, epochs: int) -> None:
        self._path = folder / LAST_CHECKPOINT
        self._every = max(1, epochs // CHECKPOINTS)

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        """Replace the last checkpoint where one is due."""
        if (trainer.current_epoch + 1) % self._every == 0:
            unfinished = self._path.with_suffix(".partial")
            trainer.save_checkpoint(unfinished)
            os.replace(unfinished, self._path)
