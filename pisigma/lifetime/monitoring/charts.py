"""Values over sessions: control charts with a stated rate of false alarms, and the changes that explain them best."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from pisigma.measurement.sensors.sensor import ShownUnit

FALSE_ALARMS_PER_YEAR = 0.05
"""Number of false alarms per year of all charts of a robot together, if nothing changes."""
SESSIONS_PER_YEAR = 12
"""Number of sessions per year, with which a rate per year is converted to a rate per session."""
_WEIGHT = 0.2
"""Weight of the newest session in the moving average."""
_ALLOWANCE = 0.5
"""Part of a score that is not added to the cumulative sums [standard deviations of a score]."""
_STATES = 101
"""Number of states of the Markov chain from which the limit of the EWMA is computed."""
_OVERSHOOT = 1.166
"""Mean overshoot of a cumulative sum over its limit for normal scores, on both sides (Siegmund 1985)."""

AlarmKind = Literal["EWMA", "CUSUM"]


@dataclass(frozen=True)
class Limits:
    """Limits of the statistics of a chart [standard deviations].

    Attributes:
        ewma: limit of the exponentially weighted moving average.
        cusum: limit of the cumulative sums.
    """

    ewma: float
    cusum: float


@dataclass(frozen=True, eq=False)
class Chart:
    """Control chart of a quantity, which compares sessions with predictions from the model and earlier sessions.

    Attributes:
        quantity: charted quantity, such as "joint 2" or "error".
        unit: unit of the values.
        values: value in each session; NaN if the session does not determine it.
        sigmas: standard deviations of the values if nothing changes.
        scores: scores of the sessions, which are independent with standard deviation 1 if nothing changes.
        limits: limits of EWMA and CUSUM.
        one_sided: whether only an increase counts.
    """

    quantity: str
    unit: ShownUnit
    values: Float64[Tensor, " sessions"]
    sigmas: Float64[Tensor, " sessions"]
    scores: Float64[Tensor, " sessions"]
    limits: Limits
    one_sided: bool = False

    @cached_property
    def ewma(self) -> Float64[Tensor, " sessions"]:
        """Exponentially weighted moving average of the scores; Roberts 1959, Technometrics 1(3)."""
        average, averages = 0.0, []
        for score in self.scores.tolist():
            average = average if math.isnan(score) else (1 - _WEIGHT) * average + _WEIGHT * score
            averages.append(average)
        return torch.tensor(averages, dtype=torch.float64)

    @cached_property
    def cusum(self) -> Float64[Tensor, "sessions 2"]:
        """Cumulative sums of increases and of decreases; Page 1954, Biometrika 41."""
        rise = fall = 0.0
        sums = []
        for score in self.scores.tolist():
            if not math.isnan(score):
                rise, fall = max(rise + score - _ALLOWANCE, 0.0), max(fall - score - _ALLOWANCE, 0.0)
            sums.append((rise, fall))
        return torch.tensor(sums, dtype=torch.float64).reshape(-1, 2)

    @property
    def ewma_to_limit_ratio(self) -> Float64[Tensor, " sessions"]:
        """Ratio of the moving average to its limit; a value above 1 is an alarm."""
        return (self.ewma if self.one_sided else self.ewma.abs()) / self.limits.ewma

    @property
    def cusum_to_limit_ratio(self) -> Float64[Tensor, " sessions"]:
        """Ratio of the larger cumulative sum to its limit; a value above 1 is an alarm."""
        return (self.cusum[:, 0] if self.one_sided else self.cusum.amax(1)) / self.limits.cusum

    @cached_property
    def sessions_outside(self) -> dict[AlarmKind, Bool[Tensor, " sessions"]]:
        """Sessions at which each statistic is outside its limit."""
        return {"EWMA": self.ewma_to_limit_ratio > 1, "CUSUM": self.cusum_to_limit_ratio > 1}

    @property
    def alarm(self) -> int | None:
        """Index of the session since which a statistic has been outside its limit; None if neither is outside now."""
        outside = torch.stack(list(self.sessions_outside.values())).any(0)
        if not len(outside) or not bool(outside[-1]):
            return None
        inside = (~outside).nonzero()[:, 0]
        return int(inside[-1]) + 1 if len(inside) else 0

    @property
    def kinds(self) -> tuple[AlarmKind, ...]:
        """Statistics that are outside their limits at the last session."""
        return tuple(
            kind for kind, outside in self.sessions_outside.items() if len(outside) and bool(outside[-1])
        )

    def to_json(self, dates: Sequence[str]) -> dict[str, Any]:
        """Return the chart as plain values, with NaN as None; `dates` are the dates of the sessions."""
        values = {
            f"values_{self.unit}": self.values,
            f"deviations_{self.unit}": self.sigmas,
            "scores": self.scores,
            "ewma_of_limit": self.ewma_to_limit_ratio,
            "cusum_of_limit": self.cusum_to_limit_ratio,
        }
        numbers = {
            name: [None if math.isnan(one) else one for one in those.tolist()]
            for name, those in values.items()
        }
        alarm = None if self.alarm is None else dates[self.alarm]
        return {"what": self.quantity, **numbers, "limits": vars(self.limits), "alarm": alarm}


def innovations(
    values: Float64[Tensor, " sessions"], covariance: Float64[Tensor, "sessions sessions"]
) -> Float64[Tensor, " sessions"]:
    """Compute independent scores of correlated values, such as values with a common error of the model.

    With the covariance `L L^T`, the scores are `L^-1 values`: every value minus its prediction from earlier values,
    divided by the standard deviation of this difference. NaN remains NaN.
    """
    scores = torch.full_like(values, torch.nan)
    there = torch.isfinite(values).nonzero()[:, 0]
    L = torch.linalg.cholesky(covariance[there[:, None], there])
    scores[there] = torch.linalg.solve_triangular(L, values[there, None], upper=False)[:, 0]
    return scores


@cache
def limits_of(charts: int, one_sided: bool = False) -> Limits:
    """Compute the limits for which all charts of a robot together have `FALSE_ALARMS_PER_YEAR`.

    The mean number of sessions to a false alarm is that of Brook and Evans 1972 (Biometrika 59(3)) for the moving
    average, as a Markov chain, and of Siegmund 1985 (Sequential Analysis, eq. 2.57) for the sums.

    Args:
        charts: number of charts, each with both statistics.
        one_sided: whether only an increase counts.
    """
    sessions = 2 * charts * SESSIONS_PER_YEAR / FALSE_ALARMS_PER_YEAR
    sides = 1 if one_sided else 2
    return Limits(
        ewma=_solved(lambda limit: mean_sessions_to_ewma_alarm(limit, one_sided), sessions, 0.1, 3.0),
        cusum=_solved(lambda limit: mean_sessions_to_cusum_alarm(limit) / sides, sessions, 0.5, 20.0),
    )


def mean_sessions_to_ewma_alarm(limit: float, one_sided: bool) -> float:
    """Compute the mean number of sessions until the moving average passes its limit (one-sided) or either limit."""
    low = -4.0 * math.sqrt(_WEIGHT / (2 - _WEIGHT)) if one_sided else -limit
    edges = torch.linspace(low, limit, _STATES + 1, dtype=torch.float64)
    middle = (edges[1:] + edges[:-1]) / 2
    until = torch.special.ndtr((edges - (1 - _WEIGHT) * middle[:, None]) / _WEIGHT)
    moves = until.diff(dim=1)
    if one_sided:  # lower values remain in the lowest state
        moves[:, 0] += until[:, 0]
    mean = torch.linalg.solve(torch.eye(_STATES, dtype=torch.float64) - moves, torch.ones_like(middle))
    return float(mean[int(middle.abs().argmin())])


def mean_sessions_to_cusum_alarm(limit: float) -> float:
    """Compute the mean number of sessions until a cumulative sum passes its limit."""
    b = 2 * _ALLOWANCE * (limit + _OVERSHOOT)
    return (math.exp(b) - b - 1) / (2 * _ALLOWANCE**2)


def _solved(sessions_of: Callable[[float], float], target: float, low: float, high: float) -> float:
    """Find the limit that has a given mean number of sessions, by bisection."""
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if sessions_of(middle) < target else (low, middle)
    return high


_MIN_DEGREES_OF_FREEDOM = 2
"""Smallest number of values in excess of the fitted coefficients."""
_MAX_EVENTS = 8
"""Number of changes of a value above which it is described by a drift."""
_MAX_EXCHANGES = 5
"""Largest number of passes that exchange events for better ones."""
_MIN_SQUARE = 1e-9
"""Squared length of a column below which it is a combination of other columns."""


@dataclass(frozen=True)
class SeriesChange:
    """A change in a series of values.

    Attributes:
        first_index: index of the first value after the change.
        is_single_value: whether only this value is changed, rather than also all later values.
    """

    first_index: int
    is_single_value: bool

    def column(self, count: int) -> Float64[Tensor, " count"]:
        """Return the column of the event: 1 for changed values, 0 for other values."""
        order = torch.arange(count)
        return (order == self.first_index if self.is_single_value else order >= self.first_index).double()


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
        self, columns: Float64[Tensor, "values columns"], events: tuple[SeriesChange, ...]
    ) -> Float64[Tensor, "values more"]:
        """Append the columns of events."""
        return torch.cat([columns, *(one.column(len(self.values))[:, None] for one in events)], 1)

    def events(self, base_columns: Tensor, drift: Tensor) -> tuple[tuple[SeriesChange, ...], bool]:
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

    def _added(self, columns: Tensor) -> tuple[tuple[SeriesChange, ...], float]:
        """Add events to columns; return the events, and the remaining sum of squares plus a penalty."""
        count, chosen = len(self.values), tuple[SeriesChange, ...]()
        penalty = 2 * math.log(max(len(self._tried), 1)) + math.log(count)
        while columns.shape[1] + len(chosen) + _MIN_DEGREES_OF_FREEDOM < count and len(chosen) < _MAX_EVENTS:
            best, gain = self._best(columns, chosen)
            if not gain > penalty:
                break
            chosen = self._exchanged(columns, (*chosen, best))
        left, _ = self._left(columns, chosen)
        return chosen, float(left.square().sum()) + penalty * len(chosen)

    def _exchanged(self, columns: Tensor, chosen: tuple[SeriesChange, ...]) -> tuple[SeriesChange, ...]:
        """Return the events after exchanging them for better ones until no exchange improves the fit."""
        for _ in range(_MAX_EXCHANGES):
            before = chosen
            for number in range(len(chosen)):
                others = chosen[:number] + chosen[number + 1 :]
                chosen = (*chosen[:number], self._best(columns, others)[0], *chosen[number + 1 :])
            if chosen == before:
                break
        return chosen

    def _best(self, columns: Tensor, chosen: tuple[SeriesChange, ...]) -> tuple[SeriesChange, float]:
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

    def _left(self, columns: Tensor, events: tuple[SeriesChange, ...]) -> tuple[Tensor, Tensor]:
        """Return the whitened residuals of the values, and an orthonormal basis of the fitted columns."""
        y, A = self.whiten(self.values[:, None])[:, 0], self.whiten(self.with_events(columns, events))
        Q = torch.linalg.qr(A)[0]
        return y - Q @ (Q.t() @ y), Q

    @cached_property
    def _tried(self) -> tuple[SeriesChange, ...]:
        """Candidate events: jumps before every value except the first, and single values except the first and last."""
        count = len(self.values)
        return (
            *(SeriesChange(number, False) for number in range(1, count)),
            *(SeriesChange(number, True) for number in range(1, count - 1)),
        )
