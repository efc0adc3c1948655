"""Pi-Sigma training as a Lightning module: one epoch is one step over all patterns."""

from collections.abc import Iterator, Sequence
from typing import Any

import lightning
import torch
from jaxtyping import Float
from torch import Tensor, nn

from pisigma.errors import TrainingError
from pisigma.network.pi_sigma import PiSigma
from pisigma.training.checkpoints import FINGERPRINT
from pisigma.training.fit_sections import FitSection, GradientDescentSection
from pisigma.training.gradient_descent import GradientDescent, set_gradient
from pisigma.training.levenberg_marquardt import LevenbergMarquardt, Patterns


class WholeBatch:
    """A loader whose only batch is everything, in memory: a DataLoader would double the time of an epoch."""

    def __init__(self, patterns: Sequence[Patterns]) -> None:
        self._batch: list[tuple[Tensor, ...]] = [(p.x, p.d, p.validation) for p in patterns]

    def __iter__(self) -> Iterator[list[tuple[Tensor, ...]]]:
        """Give the one batch."""
        yield self._batch

    def __len__(self) -> int:
        """One batch an epoch."""
        return 1


class PatternData(lightning.LightningDataModule):
    """The patterns of all networks."""

    def __init__(self, patterns: Sequence[Patterns]) -> None:
        super().__init__()
        self.patterns = patterns

    def train_dataloader(self) -> WholeBatch:
        """All patterns as one batch."""
        return WholeBatch(self.patterns)


class PiSigmaTraining(lightning.LightningModule):
    """Trains the networks of all joint groups side by side, each output on its own.

    Attributes:
        energies: `(epochs, joints)`: energy of every output before the step of an epoch (Levenberg-Marquardt:
            after it), NaN for epochs that have not been.
    """

    energies: Tensor
    epochs_done: Tensor

    def __init__(self, networks: Sequence[PiSigma], fit: FitSection, labels: Sequence[Sequence[str]]) -> None:
        """Prepare the training.

        Args:
            networks: one per joint group; they are trained in place.
            fit: method and settings.
            labels: names of the joints of every group.
        """
        super().__init__()
        self.automatic_optimization = False
        self.networks = nn.ModuleList(networks)
        self.fit = fit
        self.fingerprint = ""
        self.labels = [name for names in labels for name in names]
        generator = torch.Generator().manual_seed(fit.seed)
        self.solvers = nn.ModuleList()
        if isinstance(fit, GradientDescentSection):
            self._rates = [fit.rates(names) for names in labels]
            for network in networks:
                network.initialise(fit.spread, generator)
        else:
            for network in networks:
                self.solvers.append(LevenbergMarquardt(network, fit.starts, fit.spread, fit.ridge, generator))
        self.register_buffer(
            "energies", torch.full((fit.epochs, len(self.labels)), torch.nan, dtype=torch.float64)
        )
        self.register_buffer("epochs_done", torch.zeros((), dtype=torch.int64))

    def configure_optimizers(self) -> Any:
        """The paper's rule, or none: Levenberg-Marquardt keeps its own state."""
        if isinstance(self.fit, GradientDescentSection):
            return GradientDescent(list(self.networks), self._rates)  # type: ignore[arg-type]
        return None

    def training_step(self, batch: list[tuple[Tensor, ...]], batch_idx: int) -> None:
        """Do one epoch."""
        patterns = [Patterns(*parts) for parts in batch]
        energies = self._descend(patterns) if len(self.solvers) == 0 else self._iterate(patterns)
        self._check(0, energies)
        self.energies[self.current_epoch] = energies.to(self.energies)
        self.epochs_done.fill_(self.current_epoch + 1)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say what the checkpoint belongs to."""
        checkpoint[FINGERPRINT] = self.fingerprint

    def on_train_start(self) -> None:
        """Do nothing more where a resumed training had converged already."""
        self._stop_when_converged()

    def write_networks(self) -> None:
        """Give every network its best start, once the training has ended.

        Not a hook: Lightning runs none when a training that had come to its end is resumed.

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
        """The energies of the epochs that have been."""
        return self.energies[: int(self.epochs_done)].clone()

    def _descend(self, patterns: list[Patterns]) -> Tensor:
        energies = [set_gradient(net, p.x, p.d) for net, p in zip(self.networks, patterns, strict=True)]  # type: ignore[arg-type]
        self.optimizers().step()  # type: ignore[union-attr]
        return torch.cat(energies)

    def _iterate(self, patterns: list[Patterns]) -> Tensor:
        energies = [s.iterate(p) for s, p in zip(self.solvers, patterns, strict=True)]  # type: ignore[operator]
        self._stop_when_converged()
        return torch.cat(energies)

    def _stop_when_converged(self) -> None:
        if len(self.solvers) and all(solver.converged for solver in self.solvers):
            self.trainer.should_stop = True

    def _check(self, first: int, values: Tensor) -> None:
        """Refuse values, one per joint from number `first` on, that are not finite."""
        bad = ~torch.isfinite(values)
        if bad.any():
            name = self.labels[first + int(bad.nonzero()[0])]
            raise TrainingError(
                f"the training of {name} diverged in epoch {self.current_epoch + 1} (its energy is no longer "
                f"finite); lower 'fit.learning_rate.{name}' in the recipe or use method levenberg_marquardt."
            )
