"""Progress of a training on stderr."""

from typing import Any

import lightning
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

UPDATES = 100


class EnergyProgress(lightning.Callback):
    """A bar over the epochs with the energy of every joint, drawn at most a hundred times."""

    def __init__(self, title: str) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[energy]}"),
            console=Console(stderr=True),
        )
        self._title = title

    def on_train_start(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        """Open the bar."""
        self._progress.start()
        self._task = self._progress.add_task(
            self._title, total=trainer.max_epochs, completed=trainer.current_epoch, energy=""
        )

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        """Move the bar."""
        epoch, total = trainer.current_epoch + 1, trainer.max_epochs or 1
        if epoch % max(1, total // UPDATES) == 0 or epoch == total:
            energies = " ".join(f"{value:.3g}" for value in pl_module.energies[epoch - 1].tolist())
            self._progress.update(self._task, completed=epoch, energy=f"E {energies}")

    def on_train_end(self, trainer: lightning.Trainer, pl_module: Any) -> None:
        """Close the bar."""
        self._progress.stop()

    def on_exception(self, trainer: lightning.Trainer, pl_module: Any, exception: BaseException) -> None:
        """Close the bar, so that a message behind it can be read."""
        self._progress.stop()
