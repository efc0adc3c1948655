"""Lightning's trainer as we use it: on the CPU, on one thread, silent, and Ctrl-C arrives."""

import logging
import signal
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
import torch

_HARMLESS = (
    "does not have many workers",
    "will run with no optimizer",
    "isinstance.treespec",
    "Trainer already configured",
)


def train(
    module: lightning.LightningModule,
    data: Any,
    epochs: int,
    callbacks: Sequence[lightning.Callback],
    checkpoint: Path | None,
) -> None:
    """Train a module in place.

    Args:
        module: to train.
        data: a `LightningDataModule`, or what gives the batches of an epoch.
        epochs: to train.
        callbacks: called on the way.
        checkpoint: to go on from; None starts afresh.

    Raises:
        KeyboardInterrupt: the user had enough.
    """
    with _one_thread(), _quiet(), _keyboard_interrupts():
        trainer = lightning.Trainer(
            max_epochs=epochs,
            accelerator="cpu",
            devices=1,
            logger=False,
            callbacks=list(callbacks),
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            use_distributed_sampler=False,
        )
        if isinstance(data, lightning.LightningDataModule):
            trainer.fit(module, datamodule=data, ckpt_path=checkpoint)
        else:
            trainer.fit(module, data, ckpt_path=checkpoint)
        if trainer.interrupted:
            raise KeyboardInterrupt


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
