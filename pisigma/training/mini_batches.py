"""Hybrid calibrations of many rows: chosen on some of them, trained on mini-batches of all."""

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import lightning
from torch import Tensor

from pisigma.errors import TrainingError
from pisigma.hybrid.calibrator import HybridCalibrator, searched_rows
from pisigma.hybrid.refinement import Refined, refine, seen_from
from pisigma.hybrid.result import HybridResult
from pisigma.hybrid.search import Additive
from pisigma.identification.problem.loss import AbstractLoss
from pisigma.identification.result_assembly import SolvedCalibration
from pisigma.measurement.dataset import Measurements
from pisigma.training.batch_training import BatchSchedule, BatchTraining
from pisigma.training.checkpoint_writer import CheckpointWriter
from pisigma.training.checkpoints import discard_checkpoints, find_checkpoint, prepare_checkpoints
from pisigma.training.trainer import train
from pisigma.training.whitened_unknowns import WhitenedUnknowns

STEPS = 300
"""Without a number of epochs there are at least so many steps, and `FEWEST_EPOCHS`."""
FEWEST_EPOCHS = 8
SETTLED = 0.5
"""[standard deviations of what all rows say] The unknowns are that near to the optimum, or more epochs are advised."""


@dataclass(frozen=True)
class MiniBatches:
    """How the unknowns are trained.

    Attributes:
        batch_rows: rows of a mini-batch.
        epochs: how often every row is seen; None for as often as it takes.
        learning_rate: first step of every unknown, in standard deviations of what the rows say on which the model
            is chosen.
        seed: of the order of the rows.
    """

    batch_rows: int = 4_096
    epochs: int | None = None
    learning_rate: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse settings that make no sense."""
        for name, least in (("batch_rows", 1), ("epochs", 1), ("seed", 0)):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < least):
                raise TrainingError(f"{name}={value!r}: a whole number of at least {least} was wanted.")
        if not 0 < self.learning_rate < math.inf:
            raise TrainingError(
                f"learning_rate={self.learning_rate:g}: a positive number was wanted; 0.3 suits most data."
            )

    def schedule(self, rows: int) -> BatchSchedule:
        """For so many rows."""
        batches = math.ceil(rows / self.batch_rows)
        epochs = self.epochs or max(FEWEST_EPOCHS, math.ceil(STEPS / batches))
        return BatchSchedule(batches, epochs, self.learning_rate, self.seed)


def fit_in_batches(
    calibrator: HybridCalibrator,
    measurements: Measurements,
    progress: Callable[[str], None] = lambda what: None,
    *,
    batches: MiniBatches = MiniBatches(),
    checkpoints: Path | None = None,
    resume: bool = False,
) -> HybridResult:
    """Calibrate as `HybridCalibrator.fit` does, but train the unknowns on mini-batches.

    Features, product units, prior sizes and noise come from the rows that the calibrator searches on. All unknowns
    are then trained on all rows, whitened with what those rows say; a last pass over all rows finds how sure they
    are.

    Args:
        calibrator: what may be chosen.
        measurements: what was measured.
        progress: called with what is being done.
        batches: how the unknowns are trained.
        checkpoints: folder for checkpoints of the training; None keeps none.
        resume: go on from the checkpoint there.

    Returns:
        The result; its verdict says how near to the optimum the training came.

    Raises:
        IdentificationError: see `HybridCalibrator.fit`.
        PoseError: the joint values do not fit the robot.
        TrainingError: the training diverged, or there is no checkpoint of this calibration to resume.
        OutputError: checkpoints cannot be written.
    """
    training = _Training(batches, progress, checkpoints)
    if checkpoints is not None:
        identity = f"{batches}|{calibrator}|{measurements.content_hash()}"
        training.fingerprint = hashlib.sha256(identity.encode()).hexdigest()
        training.resume = resume
        if resume:
            find_checkpoint(checkpoints, training.fingerprint)
        else:
            prepare_checkpoints(checkpoints)
    result = calibrator.fit(measurements, progress, training)
    if checkpoints is not None:
        discard_checkpoints(checkpoints)
    if result.learned is None:
        return result
    return replace(result, verdict=f"{result.verdict} {training.sentence}")


class _Training:
    """Fits a chosen model on mini-batches, in place of `pisigma.hybrid.refinement.refine`.

    Attributes:
        fingerprint: says what calibration and data a checkpoint belongs to.
        resume: whether to go on from a checkpoint.
        sentence: how near to the optimum it came, in the end.
    """

    def __init__(
        self, batches: MiniBatches, progress: Callable[[str], None], checkpoints: Path | None
    ) -> None:
        self.batches, self.progress, self.checkpoints = batches, progress, checkpoints
        self.fingerprint, self.resume, self.sentence = "", False, ""

    def __call__(
        self, solved: SolvedCalibration, additive: Additive, orders: tuple[int, ...], loss: AbstractLoss
    ) -> Refined:
        """See `refine`."""
        some = replace(solved, problem=searched_rows(solved.problem))
        unknowns = WhitenedUnknowns.around(refine(some, additive, orders, loss))
        schedule = self.batches.schedule(solved.problem.q.shape[0])
        module = BatchTraining(solved.problem, unknowns, schedule, self.progress, self.fingerprint)
        callbacks: list[lightning.Callback] = []
        checkpoint = None
        if self.checkpoints is not None:
            callbacks.append(CheckpointWriter(self.checkpoints, schedule.epochs))
            if self.resume:
                checkpoint, _ = find_checkpoint(self.checkpoints, self.fingerprint)
        train(module, range(schedule.batches), schedule.epochs, callbacks, checkpoint)
        design, posterior = unknowns.solution(module.solution())
        self.progress("looking at all rows")
        seen = seen_from(solved, replace(design, problem=solved.problem), posterior, loss, schedule.epochs)
        return self._judged(seen, posterior.x, schedule.epochs)

    def _judged(self, seen: Refined, x: Tensor, epochs: int) -> Refined:
        """The unknowns as trained, and a sentence on how far from the optimum they are."""
        deviation = seen.posterior.covariance.diagonal().clamp(min=1e-300).sqrt()
        off = float(((seen.posterior.x - x) / deviation).square().mean().sqrt())
        self.sentence = f"Trained on mini-batches to within {off:.2g} standard deviations of the optimum."
        if not off <= SETTLED:
            self.sentence += f" That is not settled: give more than {epochs} epochs."
        return replace(seen, posterior=replace(seen.posterior, x=x))
