"""Running a training with Lightning: checkpoints, resuming, quiet on stdout."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.callbacks import ModelCheckpoint
from torch import Tensor

from pisigma.errors import TrainingError
from pisigma.network.pi_sigma import PiSigma
from pisigma.training.fit_sections import FitSection
from pisigma.training.levenberg_marquardt import Patterns
from pisigma.training.lightning_module import PatternData, PiSigmaTraining
from pisigma.training.progress import EnergyProgress

CHECKPOINTS = 20
"""How often a whole training is saved."""

_CHECKPOINT = "last.ckpt"


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
        TrainingError: the training diverged, or there is no checkpoint of this recipe and data to resume from.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    module = PiSigmaTraining(networks, fit, labels)
    callbacks: list[lightning.Callback] = [EnergyProgress(title)] if show_progress else []
    start, checkpoint = 0, None
    if checkpoints is not None:
        if resume:
            checkpoint, start = _find_checkpoint(checkpoints, fingerprint)
        callbacks.append(_checkpointing(checkpoints, fit.epochs))
        module.fingerprint = fingerprint
    with _one_thread(), warnings.catch_warnings():
        for harmless in (".*does not have many workers.*", ".*will run with no optimizer.*", ".*isinstance.treespec.*",
                         ".*exists and is not empty.*", ".*Trainer already configured.*"):
            warnings.filterwarnings("ignore", harmless)
        trainer = lightning.Trainer(
            max_epochs=fit.epochs,
            accelerator="cpu",
            devices=1,
            logger=False,
            callbacks=callbacks,
            enable_checkpointing=checkpoints is not None,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
        )
        trainer.fit(module, datamodule=PatternData(patterns), ckpt_path=checkpoint)
    if trainer.interrupted:
        raise KeyboardInterrupt
    return TrainingHistory(tuple(module.labels), module.history, start)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread: on a hundred patterns, handing work to a second one costs more than the work."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _checkpointing(folder: Path, epochs: int) -> ModelCheckpoint:
    return ModelCheckpoint(
        dirpath=folder,
        filename="epoch",
        save_last=True,
        save_top_k=1,
        every_n_epochs=max(1, epochs // CHECKPOINTS),
        enable_version_counter=False,
        save_on_train_epoch_end=True,
    )


def _find_checkpoint(folder: Path, fingerprint: str) -> tuple[Path, int]:
    path = folder / _CHECKPOINT
    if not path.is_file():
        raise TrainingError(f"{folder}: there is no interrupted training to resume; run the same command without --resume.")
    state = torch.load(path, map_location="cpu", weights_only=True)
    if state.get("pisigma_fingerprint") != fingerprint:
        raise TrainingError(
            f"{folder}: the interrupted training there is of another recipe or other data; "
            "run without --resume to start afresh, or choose another --out."
        )
    return path, int(state["epoch"]) + 1
