"""Running a training with Lightning: checkpoints, resuming, quiet on stdout."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from jaxtyping import Float
from torch import Tensor

from pisigma.errors import TrainingError
from pisigma.network.pi_sigma import PiSigma
from pisigma.training.checkpoint_writer import CheckpointWriter
from pisigma.training.checkpoints import find_checkpoint, prepare_checkpoints
from pisigma.training.fit_sections import FitSection
from pisigma.training.levenberg_marquardt import Patterns
from pisigma.training.lightning_module import PatternData, PiSigmaTraining
from pisigma.training.progress import EnergyProgress
from pisigma.training.trainer import train


@dataclass(frozen=True, eq=False)
class TrainingHistory:
    """What a training left behind.

    Attributes:
        joints: names of the corrected joints.
        energies: energy of every joint in every epoch, in scaled units.
        resumed_from: epoch the training went on from, 0 for a fresh one.
    """

    joints: tuple[str, ...]
    energies: Float[Tensor, "epochs joints"]
    resumed_from: int


def fit_networks(
    networks: Sequence[PiSigma],
    patterns: Sequence[Patterns],
    labels: Sequence[Sequence[str]],
    fit: FitSection,
    *,
    title: str = "training",
    checkpoints: Path | None = None,
    fingerprint: str = "",
    resume: bool = False,
    show_progress: bool = False,
) -> TrainingHistory:
    """Train networks in place.

    Args:
        networks: one per joint group.
        patterns: their scaled patterns.
        labels: names of the joints of every group.
        fit: method and settings.
        title: shown before the progress bar.
        checkpoints: folder for checkpoints; None keeps none.
        fingerprint: says what recipe and data a checkpoint belongs to.
        resume: go on from the checkpoint in `checkpoints`.
        show_progress: draw a bar on stderr.

    Raises:
        TrainingError: a pattern is not finite, the training diverged, or there is no checkpoint of this
        recipe
            and data to resume from.
        OutputError: checkpoints cannot be written.
    """
    _check_finite(patterns, labels)
    module = PiSigmaTraining(networks, fit, labels)
    module.fingerprint = fingerprint
    callbacks: list[lightning.Callback] = [EnergyProgress(title)] if show_progress else []
    start, checkpoint = 0, None
    if checkpoints is not None:
        if resume:
            checkpoint, start = find_checkpoint(checkpoints, fingerprint)
        else:
            prepare_checkpoints(checkpoints)
        callbacks.append(CheckpointWriter(checkpoints, fit.epochs))
    train(module, PatternData(patterns), fit.epochs, callbacks, checkpoint)
    module.write_networks()
    return TrainingHistory(tuple(module.labels), module.history, start)


def _check_finite(patterns: Sequence[Patterns], labels: Sequence[Sequence[str]]) -> None:
    for part, names in zip(patterns, labels, strict=True):
        for values in (part.x, part.d):
            if not torch.isfinite(values).all():
                row = int((~torch.isfinite(values)).nonzero()[0, 0])
                raise TrainingError(
                    f"pattern {row} (counted from 0) of {', '.join(names)} is not finite; leave that row out."
                )
