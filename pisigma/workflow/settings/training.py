"""How a training is run, apart from what it computes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pisigma.files.errors import RecipeError
from pisigma.files.setting import HIDDEN


@dataclass(frozen=True)
class TrainSettings:
    """How a training is run, apart from what it computes.

    Attributes:
        checkpoints: folder for checkpoints of networks, and of a hybrid on mini-batches; None keeps none. It is not
            removed when the training is done.
        resume: go on from where an interrupted training of this folder stopped.
        show_progress: draw the bar of networks on stderr, if that is a terminal.
        logs: folder for metrics.csv of every epoch of networks, and TensorBoard's events if it is there.
        jobs: processes that judge folds and simulations side by side, with one thread each. None: threads.

    Raises:
        RecipeError: there are no jobs.
    """

    checkpoints: Annotated[Path | None, HIDDEN] = None
    resume: bool = False
    show_progress: Annotated[bool, HIDDEN] = False
    logs: Path | None = None
    jobs: int | None = None

    def __post_init__(self) -> None:
        """Refuse to work nowhere."""
        if self.jobs is not None and self.jobs < 1:
            raise RecipeError(f"jobs: 1 or more were wanted, got {self.jobs}.")
