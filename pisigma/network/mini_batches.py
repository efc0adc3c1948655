"""Adam on mini-batches of a cost that somebody else computes, averaged over the last steps."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import lightning
import torch
from jaxtyping import Float64
from torch import Tensor, nn

from pisigma.files.errors import TrainingError
from pisigma.network.trainer import Checkpoints, train

FINAL_RATE = 0.1
"""The learning rate falls along a cosine to this share of what it begins with."""
AVERAGED = 0.5
"""Share of the steps, the last ones, over which the unknowns are averaged."""
MOMENTA = (0.9, 0.99)
"""Of Adam: of the gradient, and of its square."""

BatchCost = Callable[[Tensor, int, int], tuple[Tensor, float]]
"""From unknowns, number of the epoch and of the batch to the cost, which is derived by the unknowns, and the mean
squared residual of the batch in units of the noise."""


@dataclass(frozen=True)
class BatchSchedule:
    """How long and how fast.

    Attributes:
        batches: of an epoch.
        epochs: how often every row is visited.
        learning_rate: first step of every unknown, in the unit in which the unknowns count.
        seed: of the order of the rows.
    """

    batches: int
    epochs: int
    learning_rate: float
    seed: int

    @property
    def steps(self) -> int:
        """Of the whole training."""
        return self.batches * self.epochs

    def rate(self, step: int) -> float:
        """Share of the learning rate at a step."""
        done = min(step / self.steps, 1.0)
        return FINAL_RATE + (1 - FINAL_RATE) * (1 + math.cos(math.pi * done)) / 2


def minimise_in_batches(
    cost: BatchCost,
    unknowns: int,
    schedule: BatchSchedule,
    progress: Callable[[str], None],
    checkpoints: Checkpoints | None = None,
) -> Float64[Tensor, " unknowns"]:
    """Minimise a cost from 0 on; the average over the last steps (Polyak and Juditsky 1992).

    Args:
        cost: of a batch.
        unknowns: how many.
        schedule: how long and how fast.
        progress: called with a sentence after every epoch.
        checkpoints: kept on the way; None keeps none.

    Raises:
        TrainingError: the training diverged, or the checkpoint to resume is of something else.
    """
    module = _BatchTraining(cost, unknowns, schedule, progress)
    train(module, range(schedule.batches), schedule.epochs, checkpoints=checkpoints)
    if checkpoints is not None:
        checkpoints.discard()
    return module.average.detach()


class _BatchTraining(lightning.LightningModule):
    """The loop.

    Attributes:
        z: the unknowns.
        average: mean of z over the last steps.
        averaged: number of these steps so far.
        misfit: mean squared residual of the epoch so far.
    """

    average: Tensor
    averaged: Tensor
    misfit: Tensor

    def __init__(
        self, cost: BatchCost, unknowns: int, schedule: BatchSchedule, progress: Callable[[str], None]
    ) -> None:
        super().__init__()
        self.cost, self.schedule, self.progress = cost, schedule, progress
        nothing = torch.zeros(unknowns, dtype=torch.float64)
        self.z = nn.Parameter(nothing.clone())
        self.register_buffer("average", nothing.clone())
        self.register_buffer("averaged", torch.zeros((), dtype=torch.int64))
        self.register_buffer("misfit", torch.zeros((), dtype=torch.float64))

    def configure_optimizers(self) -> Any:
        """Adam whose steps get shorter."""
        adam = torch.optim.Adam([self.z], lr=self.schedule.learning_rate, betas=MOMENTA)
        falling = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: self.schedule.rate(step))
        return {"optimizer": adam, "lr_scheduler": {"scheduler": falling, "interval": "step"}}

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """Cost of a batch."""
        cost, misfit = self.cost(self.z, self.current_epoch, batch)
        self.misfit += (misfit - self.misfit) / (batch_idx + 1)
        return cost

    def on_train_batch_end(self, outputs: Any, batch: int, batch_idx: int) -> None:
        """Average the unknowns of the last steps."""
        step = self.current_epoch * self.schedule.batches + batch_idx + 1
        if step > (1 - AVERAGED) * self.schedule.steps:
            self.averaged += 1
            self.average += (self.z.detach() - self.average) / self.averaged

    def on_train_epoch_end(self) -> None:
        """Say how far it is.

        Raises:
            TrainingError: the training diverged.
        """
        misfit = float(self.misfit.sqrt())
        if not math.isfinite(misfit) or not bool(torch.isfinite(self.z).all()):
            raise TrainingError(
                f"the training on mini-batches diverged in epoch {self.current_epoch + 1}; lower learning_rate "
                f"({self.schedule.learning_rate:g})."
            )
        self.progress(
            f"mini-batches, epoch {self.current_epoch + 1} of {self.schedule.epochs}, residuals {misfit:.3f} times "
            "the noise"
        )
