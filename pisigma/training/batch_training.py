"""Training all unknowns of a hybrid on mini-batches, through the kinematics, as a Lightning module."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import lightning
import torch
from jaxtyping import Float64, Int64
from torch import Tensor, nn

from pisigma.errors import TrainingError
from pisigma.hybrid.sensor_values import SensorValues, sensor_values
from pisigma.identification.problem.problem import CalibrationProblem
from pisigma.training.checkpoints import FINGERPRINT
from pisigma.training.whitened_unknowns import WhitenedUnknowns

FINAL_RATE = 0.1
"""The learning rate falls along a cosine to this share of what it begins with."""
AVERAGED = 0.5
"""The last part of the steps, over which the unknowns are averaged."""
MOMENTA = (0.9, 0.99)
"""Of Adam: of the gradient, and of its square."""


@dataclass(frozen=True)
class BatchSchedule:
    """How long and how fast.

    Attributes:
        batches: of an epoch.
        epochs: how often every row is seen.
        learning_rate: first step of every unknown in standard deviations of what a part of the rows say.
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


class BatchRows:
    """Parts the rows into batches, in another order every epoch.

    Rows of a pair stay together. Rows of sensors that are certain are in every batch: they are few and hold the
    scale.
    """

    def __init__(self, problem: CalibrationProblem, schedule: BatchSchedule) -> None:
        """Look which rows go together."""
        rows, pairs = problem.q.shape[0], problem.pairs
        unit = torch.arange(rows)
        unit[: 2 * pairs] //= 2
        unit[2 * pairs :] -= pairs
        always = torch.zeros(rows, dtype=torch.bool)
        for sensor in problem.sensors:
            if sensor.certain:
                always |= sensor.seen.cpu()
        self._unit, self._always, self._schedule = unit, always, schedule
        self._epoch, self._batch_of_unit = -1, unit

    def of(self, epoch: int, batch: int) -> tuple[Int64[Tensor, " chosen"], Float64[Tensor, " chosen"]]:
        """Rows of a batch in ascending order, and how often each counts; an epoch adds up to `batches` times all."""
        if epoch != self._epoch:
            generator = torch.Generator().manual_seed(self._schedule.seed + epoch)
            units = int(self._unit[-1]) + 1
            self._batch_of_unit = torch.randperm(units, generator=generator) % self._schedule.batches
            self._epoch = epoch
        rows = ((self._batch_of_unit[self._unit] == batch) | self._always).nonzero()[:, 0]
        return rows, torch.where(self._always[rows], 1.0, float(self._schedule.batches)).double()


class BatchTraining(lightning.LightningModule):
    """Adam on whitened unknowns, averaged over the last steps (Polyak and Juditsky 1992).

    The cost of a step is that of all rows and of the prior as the batch shows it, divided by how many times more
    rows there are than the unknowns were whitened with: about `|z|² / 2`. Residuals and their derivatives by
    geometry and joint values come in closed form from the kinematics, those of the network by backpropagation.

    Attributes:
        z: whitened unknowns.
        average: mean of z over the last steps.
        averaged: number of these steps so far.
    """

    average: Tensor
    averaged: Tensor
    misfit: Tensor

    def __init__(
        self,
        problem: CalibrationProblem,
        unknowns: WhitenedUnknowns,
        schedule: BatchSchedule,
        progress: Callable[[str], None],
        fingerprint: str = "",
    ) -> None:
        """Prepare.

        Args:
            problem: all rows.
            unknowns: whitened with a part of the rows.
            schedule: how long and how fast.
            progress: called with a sentence after every epoch.
            fingerprint: says what calibration and data a checkpoint belongs to.
        """
        super().__init__()
        self.problem, self.unknowns, self.schedule = problem, unknowns, schedule
        self.progress, self.fingerprint = progress, fingerprint
        self._rows = BatchRows(problem, schedule)
        self._share = unknowns.design.problem.q.shape[0] / problem.q.shape[0]
        nothing = torch.zeros(len(unknowns.start), dtype=torch.float64)
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
        """Cost whose derivative is that of the batch's rows and the prior."""
        rows, counts = self._rows.of(self.current_epoch, batch)
        part = self.problem.select(rows.to(self.problem.q.device))
        x = self.unknowns.values(self.z.to(part.q))
        delta = self.unknowns.shift(x, part.state)
        cost = 0.5 * (self.unknowns.precision * x.square()).sum()
        found = x.detach()[: len(part.active)]
        point = part.nominal.index_add(0, part.active, found)
        values = sensor_values(part, point, partial(_as_given, delta.detach()))
        misfit, seen = 0.0, 0.0
        for number, sensor in enumerate(values):
            root = self._root(part, number, sensor) * counts.to(part.q)[sensor.row].sqrt()
            force = sensor.residual * root[:, None].square()
            moved = sensor.geometry @ x[: len(part.active)]
            moved = moved + torch.einsum("rcj,rj->rc", sensor.joints, delta[sensor.row])
            if sensor.other_row is not None and sensor.other_joints is not None:
                moved = moved + torch.einsum("rcj,rj->rc", sensor.other_joints, delta[sensor.other_row])
            cost = cost - (force * moved).sum()
            misfit += float((force * sensor.residual).sum())
            seen += float(counts.to(part.q)[sensor.row].sum()) * sensor.components
        self.misfit += (misfit / seen - self.misfit) / (batch_idx + 1)
        return self._share * cost

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

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say what the checkpoint belongs to."""
        checkpoint[FINGERPRINT] = self.fingerprint

    @torch.no_grad()
    def solution(self) -> Float64[Tensor, " unknowns"]:
        """The averaged unknowns."""
        return self.unknowns.values(self.average.to(self.problem.q))

    def _root(self, part: CalibrationProblem, number: int, sensor: SensorValues) -> Float64[Tensor, " seen"]:
        """Root of every row's weight over its variance."""
        root = sensor.root / self.unknowns.found.noise[number]
        distance = sensor.residual.norm(dim=1) * root
        loss = part.loss_of(part.sensors[number])
        return root * loss.weight(distance, sensor.components).sqrt()


def _as_given(delta: Tensor, state: Tensor) -> Tensor:
    return delta
