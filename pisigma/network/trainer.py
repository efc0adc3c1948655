"""Run Lightning's trainer on one CPU thread, with checkpoints and without output on stdout."""

import logging
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from pisigma.files.errors import Place, TrainingError
from pisigma.files.output_file import write_failure

SAVED = 20
"""Approximate number of checkpoints that a training writes."""

_NAME = "last"
_FINGERPRINT = "pisigma_fingerprint"

_HARMLESS = (
    "does not have many workers",
    "isinstance.treespec",
    "Trainer already configured",
    "Checkpoint directory .* exists and is not empty",
    "Experiment logs directory .* exists and is not empty",
    "smaller than the logging interval",
    "GPU available but not used",
)


@dataclass(frozen=True)
class Checkpoints:
    """Folder and settings of the checkpoints of a training.

    Attributes:
        folder: folder of the checkpoints.
        fingerprint: identifier of the settings and data of a checkpoint.
        resume: whether to resume from the checkpoint in the folder.
    """

    folder: Path
    fingerprint: str
    resume: bool = False

    @property
    def file(self) -> Path:
        """Path of the last checkpoint."""
        return self.folder / f"{_NAME}.ckpt"

    def prepare(self) -> None:
        """Create the folder and remove an older checkpoint, or check the checkpoint to resume from.

        Raises:
            TrainingError: there is no checkpoint to resume from, it is damaged, or it has other settings or data.
            OutputError: the folder cannot be written.
        """
        if self.resume:
            self._check()
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.file.unlink(missing_ok=True)
        except OSError as problem:
            raise write_failure(self.folder, problem) from None

    def _check(self) -> None:
        expected, remedy = "an interrupted training", "run without --resume"
        if not self.file.is_file():
            problem = "there is no interrupted training to resume"
            raise TrainingError(problem, expected=expected, at=Place(self.folder), remedy=remedy)
        try:
            fingerprint = torch.load(self.file, map_location="cpu", weights_only=True)[_FINGERPRINT]
        except (OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError, pickle.UnpicklingError):
            expected = "a complete checkpoint of pisigma"
            raise TrainingError(expected=expected, at=Place(self.file), remedy=remedy) from None
        if fingerprint != self.fingerprint:
            raise TrainingError(
                "the recipe or the data differ from those of the interrupted training",
                expected="the same recipe and data",
                at=Place(self.folder),
                remedy="run without --resume to start from scratch, or choose another --out",
            )


class _Fingerprint(lightning.Callback):
    """Callback that writes the fingerprint of settings and data into every checkpoint."""

    def __init__(self, fingerprint: str) -> None:
        self._fingerprint = fingerprint

    def on_save_checkpoint(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        checkpoint[_FINGERPRINT] = self._fingerprint


def train(
    module: lightning.LightningModule,
    data: Any,
    epochs: int,
    *,
    checkpoints: Checkpoints | None = None,
    show_progress: bool = False,
    logs: Path | None = None,
) -> None:
    """Train a Lightning module in place.

    Args:
        module: module to train.
        data: loader of the batches of an epoch.
        epochs: largest number of epochs; about `SAVED` checkpoints are written, and one at the end.
        checkpoints: folder and settings of checkpoints; None writes no checkpoints.
        show_progress: whether to draw Lightning's progress bar on stderr if it is a terminal.
        logs: folder for Lightning's logs: `metrics.csv`, and TensorBoard events if TensorBoard is installed.

    Raises:
        TrainingError: there is no checkpoint with these settings and data to resume from.
        OutputError: the folder of the checkpoints cannot be written.
        KeyboardInterrupt: the user pressed Ctrl-C.
    """
    callbacks: list[lightning.Callback] = []
    if checkpoints is not None:
        checkpoints.prepare()
        callbacks += [_Fingerprint(checkpoints.fingerprint), _saving(checkpoints.folder, epochs)]
    bar = show_progress and sys.stderr.isatty()
    if bar:
        callbacks.append(RichProgressBar(refresh_rate=10, console_kwargs={"stderr": True}))
    with _one_thread(), _quiet(), _keyboard_interrupts():
        trainer = lightning.Trainer(
            max_epochs=epochs,
            accelerator="cpu",
            devices=1,
            logger=_loggers(logs) or False,
            log_every_n_steps=1,
            callbacks=callbacks,
            enable_checkpointing=checkpoints is not None,
            enable_progress_bar=bar,
            enable_model_summary=False,
            use_distributed_sampler=False,
        )
        resumed = checkpoints.file if checkpoints is not None and checkpoints.resume else None
        trainer.fit(module, data, ckpt_path=resumed)
        if trainer.interrupted:
            raise KeyboardInterrupt


def _saving(folder: Path, epochs: int) -> ModelCheckpoint:
    """Return a callback that replaces the last checkpoint at regular intervals; Lightning replaces it atomically."""
    return ModelCheckpoint(
        dirpath=folder,
        filename=_NAME,
        every_n_epochs=max(1, epochs // SAVED),
        save_on_train_epoch_end=True,
        enable_version_counter=False,
    )


def _loggers(folder: Path | None) -> list[Logger]:
    if folder is None:
        return []
    loggers: list[Logger] = [CSVLogger(os.fspath(folder), name="", version="")]
    if find_spec("tensorboard") or find_spec("tensorboardX"):
        loggers.append(TensorBoardLogger(os.fspath(folder), name="", version=""))
    return loggers


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread within the block; for a hundred patterns, a second thread costs more than it saves."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Lightning's hints and warnings about choices that were made on purpose."""
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
    """Raise `KeyboardInterrupt` on Ctrl-C; Lightning would exit with status 1 and ignore later interrupts."""
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
