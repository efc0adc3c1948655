"""Train Pi-Sigma networks with Lightning: the paper's gradient descent, Levenberg-Marquardt, or mini-batches."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.data import DataLoader, Sampler, TensorDataset

from pisigma.files.errors import TrainingError
from pisigma.network.energy import TrainingHistory, energy, energy_gradient
from pisigma.network.levenberg_marquardt import LevenbergMarquardt, Patterns
from pisigma.network.pi_sigma import PiSigma
from pisigma.network.sections import FitSection, GradientDescentSection, MiniBatchSection
from pisigma.network.trainer import SAVED, Checkpoints, train


def fit_networks(
    networks: Sequence[PiSigma],
    patterns: Sequence[Patterns],
    joint_names: Sequence[Sequence[str]],
    fit: FitSection,
    *,
    checkpoints: Checkpoints | None = None,
    show_progress: bool = False,
    logs: Path | None = None,
) -> TrainingHistory:
    """Train networks in place.

    Args:
        networks: one network per joint group.
        patterns: scaled patterns of every network.
        joint_names: names of the joints of every group.
        fit: method and settings.
        checkpoints: folder and settings of checkpoints; None writes no checkpoints.
        show_progress: whether to draw a progress bar on stderr if it is a terminal.
        logs: folder for the energies of every epoch as `metrics.csv`; None writes no file.

    Raises:
        TrainingError: a pattern is not finite, the training diverged, or there is no checkpoint with these settings
            and data to resume from.
        OutputError: checkpoints cannot be written.
    """
    _check_finite(patterns, joint_names)
    module = NetworkTraining(networks, fit, joint_names)
    batches, epochs = _batches(patterns, fit)
    train(module, batches, epochs, checkpoints=checkpoints, show_progress=show_progress, logs=logs)
    module.write_networks()
    return TrainingHistory(tuple(module.labels), module.history, module.resumed_from)


def _check_finite(patterns: Sequence[Patterns], labels: Sequence[Sequence[str]]) -> None:
    for group, names in zip(patterns, labels, strict=True):
        for values in (group.x, group.d):
            if not torch.isfinite(values).all():
                row = int((~torch.isfinite(values)).nonzero()[0, 0])
                problem = f"pattern {row} (counted from 0) of {', '.join(names)} is not finite"
                remedy = "leave that row out"
                raise TrainingError(problem, expected="finite patterns", value=row, remedy=remedy)


def _batches(patterns: Sequence[Patterns], fit: FitSection) -> tuple[Any, int]:
    """Return the data loader for Lightning and the number of its epochs.

    If every step uses all patterns, an epoch of Lightning is a twentieth of the training, because its hooks cost more
    than a step. The module ends the last epoch early if the number of steps is not a multiple of twenty.
    """
    tensors = [values for group in patterns for values in (group.x, group.d, group.validation)]
    if not isinstance(fit, MiniBatchSection):
        share = math.ceil(fit.epochs / SAVED)
        return WholeBatches(tensors, share), math.ceil(fit.epochs / share)
    order = ShuffledBatches(len(patterns[0].d), fit.batch_rows, fit.seed)
    return DataLoader(TensorDataset(*tensors), batch_size=None, sampler=order), fit.epochs


class WholeBatches:
    """A loader that repeats the batch of all patterns; a DataLoader would double the time of a step."""

    def __init__(self, batch: list[Tensor], count: int) -> None:
        """Store the batch of all patterns and the number of times that an epoch repeats it."""
        self._batch, self._count = batch, count

    def __iter__(self) -> Iterator[list[Tensor]]:
        """Yield the batch of all patterns once per step of an epoch."""
        for _ in range(self._count):
            yield self._batch

    def __len__(self) -> int:
        """Number of batches of an epoch."""
        return self._count


class ShuffledBatches(Sampler[Tensor]):
    """Rows of mini-batches in an order that depends only on seed and epoch, so that a training resumes exactly."""

    def __init__(self, rows: int, batch_rows: int, seed: int) -> None:
        """Store the total number of rows, the rows per batch, and the seed of their order."""
        self._rows, self._batch_rows, self._seed, self._epoch = rows, batch_rows, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this before every epoch."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[Tensor]:
        """Yield the rows of every batch."""
        generator = torch.Generator().manual_seed(self._seed + self._epoch)
        yield from torch.split(torch.randperm(self._rows, generator=generator), self._batch_rows)

    def __len__(self) -> int:
        """Number of batches of an epoch."""
        return math.ceil(self._rows / self._batch_rows)


class NetworkTraining(lightning.LightningModule):
    """Lightning module that trains the networks of all joint groups in parallel, each output independently.

    Attributes:
        energies: `(epochs, joints)`: see `TrainingHistory`; NaN for epochs that are not completed.
        epochs_done: number of completed epochs.
        resumed_from: number of completed epochs in the checkpoint from which the training was resumed.
    """

    energies: Tensor
    epochs_done: Tensor

    def __init__(self, networks: Sequence[PiSigma], fit: FitSection, labels: Sequence[Sequence[str]]) -> None:
        """Prepare the training.

        Args:
            networks: one network per joint group; they are trained in place.
            fit: method and settings.
            labels: names of the joints of every group.
        """
        super().__init__()
        self.automatic_optimization = isinstance(fit, MiniBatchSection)
        self.networks = nn.ModuleList(networks)
        self.fit, self.resumed_from = fit, 0
        self.labels = [name for names in labels for name in names]
        generator = torch.Generator().manual_seed(fit.seed)
        self.solvers = nn.ModuleList()
        for network in networks:
            if isinstance(fit, GradientDescentSection | MiniBatchSection):
                network.initialise(fit.spread, generator)
            else:
                self.solvers.append(LevenbergMarquardt(network, fit.starts, fit.spread, fit.ridge, generator))
        self._rates = (
            [fit.rates(group) for group in labels] if isinstance(fit, GradientDescentSection) else []
        )
        energies = torch.full((fit.epochs, len(self.labels)), torch.nan, dtype=torch.float64)
        self.register_buffer("energies", energies)
        self.register_buffer("epochs_done", torch.zeros((), dtype=torch.int64))

    def configure_optimizers(self) -> Any:
        """Return the optimiser of the training method."""
        if not isinstance(self.fit, MiniBatchSection):
            # `_descend` writes gradients times rates. Solvers write no gradients, but Lightning needs an optimiser to
            # count steps and save checkpoints.
            return torch.optim.SGD(self.networks.parameters(), lr=1.0)
        optimiser, steps = self.fit.build(self.networks.parameters()), self.trainer.estimated_stepping_batches
        falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, int(steps))
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": falling, "interval": "step"}}

    def training_step(self, batch: list[Tensor], batch_idx: int) -> Tensor | None:
        """Perform one step on a batch.

        Raises:
            TrainingError: the training diverged.
        """
        patterns = [Patterns(*batch[k : k + 3]) for k in range(0, len(batch), 3)]
        if isinstance(self.fit, MiniBatchSection):
            return self._descend_by_batch(patterns, batch_idx)
        step = self._iterate if len(self.solvers) else self._descend
        self._count(self.optimizers().step(lambda: step(patterns)))  # type: ignore[union-attr]
        self._stop_when_done()
        return None

    def on_train_epoch_end(self) -> None:
        """Count a completed epoch of mini-batches."""
        if isinstance(self.fit, MiniBatchSection):
            self._count(self.energies[int(self.epochs_done)].clone())

    def on_train_start(self) -> None:
        """Stop immediately if a resumed training was already complete."""
        self._stop_when_done()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Read the number of completed epochs from a checkpoint."""
        self.resumed_from = int(checkpoint["state_dict"]["epochs_done"])

    def write_networks(self) -> None:
        """Write the parameters of the best start into every network, after the training.

        This is not a hook, because Lightning does not run hooks when a completed training is resumed.

        Raises:
            TrainingError: a weight is not finite, because the last step diverged.
        """
        for network, solver in zip(self.networks, self.solvers, strict=False):
            solver.write_best(network)  # type: ignore[operator]
        start = 0
        for network in self.networks:
            outputs = torch.cat([p.detach().flatten(1) for p in network.parameters()], 1)
            self._check(start, outputs.sum(1))
            start += len(outputs)

    @property
    def history(self) -> Float[Tensor, "epochs joints"]:
        """Energies of the completed epochs, as a `TrainingHistory`."""
        return self.energies[: int(self.epochs_done)].clone()

    def _descend(self, patterns: list[Patterns]) -> Tensor:
        """Write `η ∂E/∂w` (Jeong et al. 1998, eq. 4) into the parameters' `grad`; return the energy of every output."""
        energies = []
        for network, group, rates in zip(self.networks, patterns, self._rates, strict=True):
            value, weight_gradient, bias_gradient = energy_gradient(network, group.x, group.d)  # type: ignore[arg-type]
            network.weight.grad, network.bias.grad = (
                weight_gradient * rates[:, None, None],
                bias_gradient * rates[:, None],
            )
            energies.append(value)
        return torch.cat(energies)

    def _iterate(self, patterns: list[Patterns]) -> Tensor:
        return torch.cat([s.iterate(p) for s, p in zip(self.solvers, patterns, strict=True)])  # type: ignore[operator]

    def _descend_by_batch(self, patterns: list[Patterns], batch_idx: int) -> Tensor:
        """Return the cost of a batch, scaled to all rows, and accumulate the energies of the epoch."""
        energies = torch.cat(
            [energy(net.products(p.x), p.d) for net, p in zip(self.networks, patterns, strict=True)]  # type: ignore[operator]
        )
        epoch = self.energies[int(self.epochs_done)]
        epoch.copy_(energies.detach() + (epoch if batch_idx else 0.0))
        return energies.sum() * self.trainer.num_training_batches

    def _count(self, energies: Tensor) -> None:
        """Record the energies of a completed epoch."""
        self._check(0, energies)
        self.energies[int(self.epochs_done)] = energies.to(self.energies)
        self.epochs_done += 1
        if self.trainer.loggers or self.trainer.progress_bar_callback:
            values = dict(zip((f"energy_{name}" for name in self.labels), energies, strict=True))
            self.log_dict(values, batch_size=1)
            self.log("energy", energies.sum(), prog_bar=True, logger=False, batch_size=1)

    def _stop_when_done(self) -> None:
        converged = len(self.solvers) > 0 and all(solver.converged for solver in self.solvers)
        if converged or int(self.epochs_done) >= self.fit.epochs:
            self.trainer.should_stop = True

    def _check(self, first: int, values: Tensor) -> None:
        """Check that values, one per joint from index `first`, are finite.

        Raises:
            TrainingError: a value is not finite.
        """
        bad = ~torch.isfinite(values)
        if bad.any():
            name = self.labels[first + int(bad.nonzero()[0])]
            rate = f".{name}" if isinstance(self.fit, GradientDescentSection) else ""
            raise TrainingError(
                f"the training of {name} diverged in epoch {int(self.epochs_done) + 1}: its energy is not finite",
                value=name,
                option=f"fit.learning_rate{rate}",
                remedy=f"lower 'fit.learning_rate{rate}' in the recipe or use method levenberg_marquardt",
            )
