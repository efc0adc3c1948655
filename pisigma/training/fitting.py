"""Running a training with Lightning: checkpoints, resuming, quiet on stdout."""

import logging
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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

_HARMLESS = (
    "does not have many workers",
    "will run with no optimizer",
    "isinstance.treespec",
    "Trainer already configured",
)


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
    with _one_thread(), _quiet(), _keyboard_interrupts():
        trainer = lightning.Trainer(
            max_epochs=fit.epochs,
            accelerator="cpu",
            devices=1,
            logger=False,
            callbacks=callbacks,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
        )
        trainer.fit(module, datamodule=PatternData(patterns), ckpt_path=checkpoint)
        if trainer.interrupted:
            raise KeyboardInterrupt
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


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread: on a hundred patterns, a second one costs more than it does."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Lightning's hints and warnings about what we do on purpose to ourselves."""
    loggers = [logging.getLogger(name) for name in ("lightning.pytorch", "lightning.fabric")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            for harmless in _HARMLESS:
                warnings.filterwarnings("ignore", f".*{harmless}.*")
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


@contextmanager
def _keyboard_interrupts() -> Iterator[None]:
    """Let Ctrl-C arrive as `KeyboardInterrupt`: Lightning exits with status 1 and ignores all later ones."""
    handler = signal.getsignal(signal.SIGINT)
    try:
        yield
    except SystemExit as problem:
        if isinstance(problem.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
    finally:
        if threading.current_thread() is threading.main_thread() and handler is not None:
            signal.signal(signal.SIGINT, handler)
