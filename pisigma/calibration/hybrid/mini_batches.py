"""Hybrid calibrations of very many rows: the unknowns of the chosen model trained on mini-batches of all rows."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import torch
from jaxtyping import Float64, Int64
from pydantic import Field, PositiveFloat, PositiveInt
from torch import Tensor

from pisigma.calibration.geometric.problem.problem import CalibrationProblem
from pisigma.calibration.geometric.result import SolvedCalibration
from pisigma.calibration.hybrid.design import Design
from pisigma.calibration.hybrid.refinement import Refined, network, refined_at
from pisigma.calibration.hybrid.sensor_values import sensor_values
from pisigma.estimation.regression import Posterior
from pisigma.files.yaml_file import Section
from pisigma.measurement.conditions import JointState

if TYPE_CHECKING:
    from pisigma.network.mini_batches import BatchSchedule
    from pisigma.network.trainer import Checkpoints

MANY_ROWS = 100_000
"""From so many rows on, mini-batches: the normal equations of a thousand unknowns would take minutes."""
STEPS = 300
"""Without a number of epochs there are at least so many steps, and `FEWEST_EPOCHS`."""
FEWEST_EPOCHS = 8
SETTLED = 0.5
"""[standard deviations of what all rows say] The unknowns are that near to the optimum, or more epochs are advised."""


class MiniBatches(Section):
    """How the unknowns are trained on mini-batches.

    Attributes:
        batch_rows: rows of a mini-batch.
        epochs: how often every row is visited; None for as often as it takes.
        learning_rate: first step of every unknown, in standard deviations of what the rows say on which the model
            is chosen.
        seed: of the order of the rows.
    """

    batch_rows: PositiveInt = 4_096
    epochs: PositiveInt | None = None
    learning_rate: PositiveFloat = 0.3
    seed: Annotated[int, Field(ge=0)] = 0

    def schedule(self, rows: int) -> "BatchSchedule":
        """For so many rows."""
        from pisigma.network.mini_batches import BatchSchedule  # imports lightning, which takes seconds

        batches = math.ceil(rows / self.batch_rows)
        epochs = self.epochs or max(FEWEST_EPOCHS, math.ceil(STEPS / batches))
        return BatchSchedule(batches, epochs, self.learning_rate, self.seed)


def batch_checkpoints(folder: Path, identity: str, resume: bool) -> "Checkpoints":
    """Checkpoints of a training, in a folder that is ready for them.

    Args:
        folder: for the checkpoints.
        identity: all settings and data, in words.
        resume: go on from the checkpoint there.

    Raises:
        TrainingError: there is no checkpoint of these settings and data to resume.
        OutputError: the folder cannot be written.
    """
    from pisigma.network.trainer import Checkpoints

    checkpoints = Checkpoints(folder, hashlib.sha256(identity.encode()).hexdigest(), resume)
    checkpoints.prepare()
    return checkpoints


def refine_in_batches(
    solved: SolvedCalibration,
    few: Refined,
    group: Int64[Tensor, " rows"],
    *,
    batches: MiniBatches,
    progress: Callable[[str], None],
    checkpoints: "Checkpoints | None" = None,
) -> tuple[Refined, str]:
    """Fit a chosen model as `pisigma.calibration.hybrid.refinement.refine` does, but on mini-batches.

    Prior sizes and noise come from some of the rows. All unknowns are then trained on all rows, whitened with what
    those rows say; a last pass over all rows finds how sure they are.

    Args:
        solved: the geometric calibration, where it starts.
        few: the model fitted to some of the rows.
        group: see `Rows.group`, of all rows.
        batches: how the unknowns are trained.
        progress: called with what is being done.
        checkpoints: kept on the way; None keeps none.

    Returns:
        The solved hybrid, and a sentence on how near to the optimum the training came.

    Raises:
        TrainingError: the training diverged, or the checkpoint to resume is of something else.
    """
    from pisigma.network.mini_batches import minimise_in_batches

    unknowns = WhitenedUnknowns.around(few)
    schedule = batches.schedule(solved.problem.q.shape[0])
    cost = HybridBatchCost(solved.problem, unknowns, schedule)
    z = minimise_in_batches(cost, len(unknowns.start), schedule, progress, checkpoints)
    posterior = replace(few.posterior, x=unknowns.values(z.to(solved.problem.q)).detach())
    progress("looking at all rows")
    refined = refined_at(replace(few.design, problem=solved.problem), posterior, group, schedule.epochs)
    deviation = refined.regression.covariance_root(refined.posterior).dense.norm(dim=1)
    off = float(((refined.posterior.x - posterior.x) / deviation).square().mean().sqrt())
    sentence = f"Trained on mini-batches to within {off:.2g} standard deviations of the optimum."
    if not off <= SETTLED:
        sentence += f" That is not settled: give more than {schedule.epochs} epochs."
    correction = network(refined.design, posterior.x)
    point = solved.problem.nominal.index_add(0, solved.problem.active, posterior.x[: few.design.active])
    there = replace(refined.posterior, x=posterior.x)
    return replace(refined, posterior=there, point=point, correction=correction), sentence


@dataclass(frozen=True, eq=False)
class WhitenedUnknowns:
    """`x = start + root · z`, where some rows say that z is about 0 with covariance 1.

    The unknowns x are the free parameters counted from nominal, and the weights of the features.

    Attributes:
        design: of the few rows.
        posterior: of their unknowns, whose prior sizes and noise stand.
        root: root of the covariance of x.
    """

    design: Design
    posterior: Posterior
    root: Float64[Tensor, "unknowns unknowns"]

    @staticmethod
    def around(few: Refined) -> "WhitenedUnknowns":
        """Around the solution of a part of the rows."""
        root = few.regression.covariance_root(few.posterior).dense
        return WhitenedUnknowns(few.design, few.posterior, root)

    @property
    def start(self) -> Float64[Tensor, " unknowns"]:
        """The unknowns x where z is 0."""
        return self.posterior.x

    @property
    def precision(self) -> Float64[Tensor, " unknowns"]:
        """1 / variance of x in the prior, whose mean is 0."""
        return self.posterior.prior.precision

    def values(self, z: Float64[Tensor, " unknowns"]) -> Float64[Tensor, " unknowns"]:
        """The unknowns x."""
        return self.start + self.root @ z

    def shift(self, x: Float64[Tensor, " unknowns"], state: JointState) -> Float64[Tensor, "rows dof"]:
        """Joint corrections [rad or m] of rows, to be derived by x."""
        return self.design.correction(x, state)


class BatchRows:
    """Divides the rows into batches, in another order every epoch.

    Rows of a pair stay together. Rows of sensors that are certain are in every batch: they are few and hold the
    scale.
    """

    def __init__(self, problem: CalibrationProblem, schedule: "BatchSchedule") -> None:
        """Look which rows go together."""
        rows, pairs = problem.q.shape[0], problem.pairs
        unit = torch.arange(rows)
        unit[: 2 * pairs] //= 2
        unit[2 * pairs :] -= pairs
        always = torch.zeros(rows, dtype=torch.bool)
        for sensor in problem.sensors:
            if sensor.certain:
                always |= sensor.present.cpu()
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


class HybridBatchCost:
    """What a batch costs at whitened unknowns: about `|z|² / 2`.

    It is the cost of all rows and of the prior as the batch shows it, divided by how many times more rows there are
    than the unknowns were whitened with. Residuals and their derivatives by geometry and joint values come in closed
    form from the kinematics, those of the network by backpropagation.
    """

    def __init__(
        self, problem: CalibrationProblem, unknowns: WhitenedUnknowns, schedule: "BatchSchedule"
    ) -> None:
        """Prepare.

        Args:
            problem: all rows.
            unknowns: whitened with some of the rows.
            schedule: how many batches, in which order.
        """
        self._problem, self._unknowns = problem, unknowns
        self._rows = BatchRows(problem, schedule)
        self._share = unknowns.design.problem.q.shape[0] / problem.q.shape[0]

    def __call__(self, z: Float64[Tensor, " unknowns"], epoch: int, batch: int) -> tuple[Tensor, float]:
        """Cost whose derivative is that of the batch's rows and the prior, and the mean squared residual."""
        rows, counts = self._rows.of(epoch, batch)
        few = self._problem.select(rows.to(self._problem.q.device))
        active, counts = len(few.active), counts.to(few.q)
        x = self._unknowns.values(z.to(few.q))
        delta = self._unknowns.shift(x, few.state)
        cost = 0.5 * (self._unknowns.precision * x.square()).sum()
        point = few.nominal.index_add(0, few.active, x.detach()[:active])
        values = sensor_values(few, point, lambda state: delta.detach())
        square, count = 0.0, 0.0
        for number, sensor in enumerate(values):
            root = sensor.root / self._unknowns.posterior.noise[number]
            distance = sensor.residual.norm(dim=1) * root
            loss = few.loss_of(few.sensors[number])
            root = root * loss.weight(distance, sensor.components).sqrt() * counts[sensor.row].sqrt()
            force = sensor.residual * root[:, None].square()
            moved = sensor.geometry @ x[:active]
            moved = moved + torch.einsum("rcj,rj->rc", sensor.joints, delta[sensor.row])
            if sensor.other_row is not None and sensor.other_joints is not None:
                moved = moved + torch.einsum("rcj,rj->rc", sensor.other_joints, delta[sensor.other_row])
            cost = cost - (force * moved).sum()
            square += float((force * sensor.residual).sum())
            count += float(counts[sensor.row].sum()) * sensor.components
        return self._share * cost, square / count
