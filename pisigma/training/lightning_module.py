"""Pi-Sigma training as a Lightning module: one epoch is one step over all patterns."""

from collections.abc import Iterator, Sequence
from typing import Any

import lightning
import torch
from jaxtyping import Float
from torch import Tensor, nn

from pisigma.errors import TrainingError
from pisigma.network.pi_sigma import PiSigma
from pisigma.training.fit_sections import FitSection, GradientDescentSection
from pisigma.training.gradient_descent import GradientDescent, set_gradient
from pisigma.training.levenberg_marquardt import LevenbergMarquardt, Patterns


class WholeBatch:
    """A loader whose only batch is everything, kept in memory: a DataLoader would double the time of an epoch."""

    def __init__(self, patterns: Sequence[Patterns]) -> None:
        self._batch = [(p.x, p.d, p.weight, p.validation) for p in patterns]

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
        energies: `(epochs, joints)`: energy of every output before the step of an epoch (Levenberg-Marquardt: after
            it), NaN for epochs that have not been.
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
        self.register_buffer("energies", torch.full((fit.epochs, len(self.labels)), torch.nan, dtype=torch.float64))
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
        self._check(energies)
        self.energies[self.current_epoch] = energies.to(self.energies)
        self.epochs_done.fill_(self.current_epoch + 1)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Say what the checkpoint belongs to."""
        checkpoint["pisigma_fingerprint"] = self.fingerprint

    def on_train_end(self) -> None:
        """Give every network its best start."""
        for network, solver in zip(self.networks, self.solvers, strict=False):
            solver.write_best(network)  # type: ignore[operator]

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
        if all(solver.converged for solver in self.solvers):
            self.trainer.should_stop = True
        return torch.cat(energies)

    def _check(self, energies: Tensor) -> None:
        bad = ~torch.isfinite(energies)
        if bad.any():
            name = self.labels[int(bad.nonzero()[0])]
            raise TrainingError(
                f"the energy of {name} is no longer finite in epoch {self.current_epoch + 1}: the training diverged; "
                "lower that joint's learning rate or use method levenberg_marquardt."
            )
