"""Changes of a value over sessions: lasting jumps, single outlying sessions, and a steady drift."""

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float64
from torch import Tensor

_MIN_DEGREES_OF_FREEDOM = 2
"""Smallest number of values in excess of the fitted coefficients."""
_MAX_EVENTS = 8
"""Number of changes of a value above which it is described by a drift."""
_MAX_EXCHANGES = 5
"""Largest number of passes that exchange events for better ones."""
_MIN_SQUARE = 1e-9
"""Squared length of a column below which it is a combination of other columns."""


@dataclass(frozen=True)
class Event:
    """A change in a series of values.

    Attributes:
        number: index of the first value after the change.
        is_single: whether only this value is changed, rather than also all later values.
    """

    number: int
    is_single: bool

    def column(self, count: int) -> Float64[Tensor, " count"]:
        """Return the column of the event: 1 for changed values, 0 for other values."""
        order = torch.arange(count)
        return (order == self.number if self.is_single else order >= self.number).double()


@dataclass(frozen=True, eq=False)
class Series:
    """A series of values with their covariance, fitted by generalised least squares."""

    values: Float64[Tensor, " values"]
    covariance: Float64[Tensor, "values values"]

    @cached_property
    def _root(self) -> Tensor:
        root: Tensor = torch.linalg.cholesky(self.covariance)
        return root

    def whiten(self, columns: Float64[Tensor, "values columns"]) -> Float64[Tensor, "values columns"]:
        """Whiten columns by the covariance of the values."""
        result: Tensor = torch.linalg.solve_triangular(self._root, columns, upper=False)
        return result

    def fit(self, columns: Float64[Tensor, "values columns"]) -> tuple[list[float], list[float]]:
        """Fit the coefficients of columns; return them and their standard deviations."""
        y, A = self.whiten(self.values[:, None]), self.whiten(columns)
        of_coefficients = torch.linalg.inv(A.t() @ A)
        return (of_coefficients @ A.t() @ y)[:, 0].tolist(), of_coefficients.diagonal().sqrt().tolist()

    def with_events(
        self, columns: Float64[Tensor, "values columns"], events: tuple[Event, ...]
    ) -> Float64[Tensor, "values more"]:
        """Append the columns of events."""
        return torch.cat([columns, *(one.column(len(self.values))[:, None] for one in events)], 1)

    def events(self, base_columns: Tensor, drift: Tensor) -> tuple[tuple[Event, ...], bool]:
        """Find the events, and whether there is also a drift.

        Both with and without a drift, events are added one by one, each time the event that explains most, as long as
        it explains more than the best of all candidates would by chance. The two fits are compared by the Bayesian
        information criterion (Schwarz 1978, Annals of Statistics 6, 461-464).

        Args:
            base_columns: columns of every fit.
            drift: columns of a drift.
        """
        steady_events, left = self._added(base_columns)
        drift_events, left_with_drift = self._added(torch.cat([base_columns, drift], 1))
        drifts = left_with_drift + drift.shape[1] * math.log(len(self.values)) < left
        return (drift_events, True) if drifts else (steady_events, False)

    def _added(self, columns: Tensor) -> tuple[tuple[Event, ...], float]:
        """Add events to columns; return the events, and the remaining sum of squares plus a penalty."""
        count, chosen = len(self.values), tuple[Event, ...]()
        penalty = 2 * math.log(max(len(self._tried), 1)) + math.log(count)
        while columns.shape[1] + len(chosen) + _MIN_DEGREES_OF_FREEDOM < count and len(chosen) < _MAX_EVENTS:
            best, gain = self._best(columns, chosen)
            if not gain > penalty:
                break
            chosen = self._exchanged(columns, (*chosen, best))
        left, _ = self._left(columns, chosen)
        return chosen, float(left.square().sum()) + penalty * len(chosen)

    def _exchanged(self, columns: Tensor, chosen: tuple[Event, ...]) -> tuple[Event, ...]:
        """Return the events after exchanging them for better ones until no exchange improves the fit."""
        for _ in range(_MAX_EXCHANGES):
            before = chosen
            for number in range(len(chosen)):
                others = chosen[:number] + chosen[number + 1 :]
                chosen = (*chosen[:number], self._best(columns, others)[0], *chosen[number + 1 :])
            if chosen == before:
                break
        return chosen

    def _best(self, columns: Tensor, chosen: tuple[Event, ...]) -> tuple[Event, float]:
        """Return the event that explains most given other events, and the resulting decrease of the sum of squares."""
        left, Q = self._left(columns, chosen)
        tried = self.whiten(torch.stack([one.column(len(self.values)) for one in self._tried], 1))
        tried = tried - Q @ (Q.t() @ tried)
        square = tried.square().sum(0)
        gain = torch.where(
            square > _MIN_SQUARE, (tried.t() @ left).square() / square.clamp(min=_MIN_SQUARE), 0.0
        )
        number = int(gain.argmax())
        return self._tried[number], float(gain[number])

    def _left(self, columns: Tensor, events: tuple[Event, ...]) -> tuple[Tensor, Tensor]:
        """Return the whitened residuals of the values, and an orthonormal basis of the fitted columns."""
        y, A = self.whiten(self.values[:, None])[:, 0], self.whiten(self.with_events(columns, events))
        Q = torch.linalg.qr(A)[0]
        return y - Q @ (Q.t() @ y), Q

    @cached_property
    def _tried(self) -> tuple[Event, ...]:
        """Candidate events: jumps before every value except the first, and single values except the first and last."""
        count = len(self.values)
        return (
            *(Event(number, False) for number in range(1, count)),
            *(Event(number, True) for number in range(1, count - 1)),
        )
