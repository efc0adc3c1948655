"""Settings for running a training; they do not change the result."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pisigma.files.errors import RecipeError
from pisigma.files.setting import HIDDEN


@dataclass(frozen=True)
class TrainSettings:
    """Settings for running a training; they do not change the result.

    Attributes:
        checkpoints: folder for checkpoints of networks, and of a hybrid trained on mini-batches. It is kept after the
            training. None: no checkpoints.
        resume: resume the interrupted training in this folder.
        show_progress: show the networks' progress bar on stderr, if that is a terminal.
        logs: folder for the metrics of every epoch (metrics.csv), and for TensorBoard if it is installed.
        jobs: number of processes that validate folds and simulations in parallel. Each uses one thread.
            None: one process with several threads.

    Raises:
        RecipeError: `jobs` is less than 1.
    """

    checkpoints: Annotated[Path | None, HIDDEN] = None
    resume: bool = False
    show_progress: Annotated[bool, HIDDEN] = False
    logs: Path | None = None
    jobs: int | None = None

    def __post_init__(self) -> None:
        """Check the number of processes."""
        if self.jobs is not None and self.jobs < 1:
            raise RecipeError(expected="an integer >= 1", value=self.jobs, option="jobs")
