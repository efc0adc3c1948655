"""Lightning's trainer as pisigma uses it: on the CPU, on one thread, with checkpoints, and silent on stdout."""

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

from pisigma.files.errors import OutputError, TrainingError

SAVED = 20
"""How often a whole training is saved."""

_NAME = "last"
_FINGERPRINT = "pisigma_fingerprint"

_HARMLESS = (
    "does not have many workers",
    "isinstance.treespec",
    "Trainer already configured",
    "Checkpoint directory .* exists and is not empty",
    "Experiment logs directory .* exists and is not empty",
    "smaller than the logging interval",
)


@dataclass(frozen=True)
class Checkpoints:
    """Where the checkpoints of a training are kept.

    Attributes:
        folder: for the checkpoints.
        fingerprint: says what settings and data a checkpoint belongs to.
        resume: go on from the checkpoint there, instead of from the start.
    """

    folder: Path
    fingerprint: str
    resume: bool = False

    @property
    def file(self) -> Path:
        """The last checkpoint."""
        return self.folder / f"{_NAME}.ckpt"

    def prepare(self) -> None:
        """Make the folder without an older checkpoint; or, to resume, check the checkpoint there.

        Raises:
            TrainingError: there is no checkpoint to resume, it is damaged, or it is of other settings or data.
            OutputError: the folder cannot be written.
        """
        if self.resume:
            self._check()
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.file.unlink(missing_ok=True)
        except OSError as problem:
            raise OutputError(
                f"{self.folder}: cannot be written ({problem.strerror}); choose another --out."
            ) from None

    def _check(self) -> None:
        if not self.file.is_file():
            raise TrainingError(
                f"{self.folder}: there is no interrupted training to resume; run without --resume."
            )
        try:
            fingerprint = torch.load(self.file, map_location="cpu", weights_only=True)[_FINGERPRINT]
        except (OSError, EOFError, RuntimeError, KeyError, TypeError, ValueError, pickle.UnpicklingError):
            raise TrainingError(
                f"{self.file}: is no whole checkpoint of pisigma; run without --resume."
            ) from None
        if fingerprint != self.fingerprint:
            raise TrainingError(
                f"{self.folder}: the interrupted training there is of another recipe or other data; "
                "run without --resume to start afresh, or choose another --out."
            )


class _Fingerprint(lightning.Callback):
    """Writes into every checkpoint what settings and data it belongs to."""

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
    """Train a module in place.

    Args:
        module: to train.
        data: what gives the batches of an epoch.
        epochs: to train at most; about `SAVED` times, and at the end, a checkpoint is written.
        checkpoints: where they are kept; None keeps none.
        show_progress: draw Lightning's bar on stderr, if that is a terminal.
        logs: folder for Lightning's logs: `metrics.csv`, and TensorBoard's events where it is installed.

    Raises:
        TrainingError: there is no checkpoint of these settings and data to resume.
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
    """Replaces the last checkpoint at even distances; Lightning renames a whole file into its place."""
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
