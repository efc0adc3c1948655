"""Changes of a value over sessions: jumps that stay, single sessions that are off, and a steady drift besides."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

SPARE = 2
"""Values beyond what is fitted to them."""
MOST_EVENTS = 8
"""A value that changes more often drifts."""
ROUNDS = 5
"""Of exchanging events for others, at most."""
LEAST = 1e-9
"""Squared length of a column below which it is a combination of others."""


@dataclass(frozen=True)
class Event:
    """A change at one of the values.

    Attributes:
        number: of the first value after it.
        alone: whether that value alone is off; else all later ones are, too.
    """

    number: int
    alone: bool

    def column(self, count: int) -> Float64[Tensor, " count"]:
        """1 where the values are others, of so many."""
        order = torch.arange(count)
        return (order == self.number if self.alone else order >= self.number).double()


@dataclass(frozen=True, eq=False)
class Series:
    """Values with their covariance, fitted by generalised least squares."""

    values: Float64[Tensor, " values"]
    covariance: Float64[Tensor, "values values"]

    @cached_property
    def _root(self) -> Tensor:
        root: Tensor = torch.linalg.cholesky(self.covariance)
        return root

    def whitened(self, columns: Float64[Tensor, "values columns"]) -> Float64[Tensor, "values columns"]:
        """Columns over the standard deviations of the values."""
        result: Tensor = torch.linalg.solve_triangular(self._root, columns, upper=False)
        return result

    def fit(self, columns: Float64[Tensor, "values columns"]) -> tuple[list[float], list[float]]:
        """Coefficients of columns, and their standard deviations."""
        y, A = self.whitened(self.values[:, None]), self.whitened(columns)
        of_coefficients = torch.linalg.inv(A.t() @ A)
        return (of_coefficients @ A.t() @ y)[:, 0].tolist(), of_coefficients.diagonal().sqrt().tolist()

    def with_events(
        self, columns: Float64[Tensor, "values columns"], events: tuple[Event, ...]
    ) -> Float64[Tensor, "values more"]:
        """Columns and those of events."""
        return torch.cat([columns, *(one.column(len(self.values))[:, None] for one in events)], 1)

    def events(self, steady: Tensor, drift: Tensor) -> tuple[tuple[Event, ...], bool]:
        """Find the jumps, and whether there is a drift beside them.

        Both with and without a drift events are added one by one, each that explains most, while it explains more than
        one that is chosen among so many does by chance. Compared are twice the logarithms of the likelihood with the
        penalties of the Bayesian information criterion (Schwarz 1978, Annals of Statistics 6, 461-464).

        Args:
            steady: columns that are there in any case.
            drift: columns of a drift.
        """
        still, left = self._added(steady)
        beside, left_beside = self._added(torch.cat([steady, drift], 1))
        drifts = left_beside + drift.shape[1] * math.log(len(self.values)) < left
        return (beside, True) if drifts else (still, False)

    def _added(self, columns: Tensor) -> tuple[tuple[Event, ...], float]:
        """Events beside some columns, and what they leave with their penalty."""
        count, chosen = len(self.values), tuple[Event, ...]()
        penalty = 2 * math.log(max(len(self._tried), 1)) + math.log(count)
        while columns.shape[1] + len(chosen) + SPARE < count and len(chosen) < MOST_EVENTS:
            best, gain = self._best(columns, chosen)
            if not gain > penalty:
                break
            chosen = self._exchanged(columns, (*chosen, best))
        left, _ = self._left(columns, chosen)
        return chosen, float(left.square().sum()) + penalty * len(chosen)

    def _exchanged(self, columns: Tensor, chosen: tuple[Event, ...]) -> tuple[Event, ...]:
        """Events of which none explains more where another one takes its place beside the others."""
        for _ in range(ROUNDS):
            before = chosen
            for number in range(len(chosen)):
                others = chosen[:number] + chosen[number + 1 :]
                chosen = (*chosen[:number], self._best(columns, others)[0], *chosen[number + 1 :])
            if chosen == before:
                break
        return chosen

    def _best(self, columns: Tensor, chosen: tuple[Event, ...]) -> tuple[Event, float]:
        """The event that explains most beside others, and what squares it takes away."""
        left, Q = self._left(columns, chosen)
        tried = self.whitened(torch.stack([one.column(len(self.values)) for one in self._tried], 1))
        tried = tried - Q @ (Q.t() @ tried)
        square = tried.square().sum(0)
        gain = torch.where(square > LEAST, (tried.t() @ left).square() / square.clamp(min=LEAST), 0.0)
        number = int(gain.argmax())
        return self._tried[number], float(gain[number])

    def _left(self, columns: Tensor, events: tuple[Event, ...]) -> tuple[Tensor, Tensor]:
        """What is left of the values, over their standard deviations, and axes of what was fitted."""
        y, A = self.whitened(self.values[:, None])[:, 0], self.whitened(self.with_events(columns, events))
        Q = torch.linalg.qr(A)[0]
        return y - Q @ (Q.t() @ y), Q

    @cached_property
    def _tried(self) -> tuple[Event, ...]:
        """A jump before every value but the first, and every value alone but the first and the last."""
        count = len(self.values)
        return (
            *(Event(number, False) for number in range(1, count)),
            *(Event(number, True) for number in range(1, count - 1)),
        )
