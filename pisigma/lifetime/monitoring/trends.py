"""Sessions over the months: charts of joints and errors, drift with time and temperature, a limit's forecast."""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.drift import NOISE_SPREAD
from pisigma.lifetime.monitoring.changes import Event, Series
from pisigma.lifetime.monitoring.charts import Chart, innovations, limits_of
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import CLEAR, NORMAL_95
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit

DAYS_PER_MONTH = 365.25 / 12
FEWEST = 4
"""Sessions on different days that a drift is estimated from."""
FEWEST_KELVINS = 3.0
"""Standard deviation of the temperatures from which on a dependence on them is estimated."""
MOST_MONTHS = 120.0
"""Beyond ten years no forecast is made."""


@dataclass(frozen=True)
class Trend:
    """How a joint's zero, or the error, changes.

    Attributes:
        what: changes.
        over: "month" or "kelvin".
        unit: of the change for one of these.
        slope: the change.
        deviation: its standard deviation.
    """

    what: str
    over: Literal["month", "kelvin"]
    unit: ShownUnit
    slope: float
    deviation: float

    @property
    def clear(self) -> bool:
        """Whether it is more than chance."""
        return abs(self.slope) > CLEAR * self.deviation

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the change."""
        half = NORMAL_95 * self.deviation
        return self.slope - half, self.slope + half

    @property
    def sentence(self) -> str:
        """It in words."""
        half = NORMAL_95 * self.deviation
        return f"{self.what} drifts by {self.slope:.4f} ± {half:.4f} {self.unit} a {self.over}"

    def to_json(self) -> dict[str, Any]:
        """The change with its interval as plain values."""
        slope = {f"{self.unit}_per_{self.over}": self.slope}
        return {"what": self.what, **slope, "interval": list(self.interval), "clear": self.clear}


@dataclass(frozen=True)
class Jump:
    """A change of a joint's zero between two sessions, as by a collision, or in one of them alone.

    Attributes:
        what: changed.
        unit: of the change.
        size: the change.
        deviation: its standard deviation.
        before: day of the last session before it.
        after: day of the first session after it.
        alone: whether that session alone is off.
    """

    what: str
    unit: ShownUnit
    size: float
    deviation: float
    before: str
    after: str
    alone: bool = False

    @property
    def sentence(self) -> str:
        """It in words."""
        half = NORMAL_95 * self.deviation
        if self.alone:
            return f"{self.what} was {self.size:.4f} ± {half:.4f} {self.unit} off on {self.after} alone"
        return f"{self.what} jumped by {self.size:.4f} ± {half:.4f} {self.unit} between {self.before} and {self.after}"

    def to_json(self) -> dict[str, Any]:
        """The jump and the sessions that it lies between as plain values."""
        return {
            "what": self.what,
            f"size_{self.unit}": self.size,
            f"deviation_{self.unit}": self.deviation,
            "before": self.before,
            "after": self.after,
            "alone": self.alone,
        }


@dataclass(frozen=True)
class Forecast:
    """When the error passes a limit.

    Attributes:
        limit_mm: the limit.
        passed: whether the error of the last session is above it.
        date: when the trend passes it; None where it does not within ten years.
        earliest: beginning of the 95 % interval of that; None likewise.
    """

    limit_mm: float
    passed: bool
    date: str | None
    earliest: str | None

    @property
    def sentence(self) -> str:
        """It in words."""
        if self.passed:
            return f"The RMS error of the last session is above the limit of {self.limit_mm:g} mm."
        if self.date is None:
            return f"No trend says that the RMS error will pass {self.limit_mm:g} mm within ten years."
        return (
            f"The RMS error will pass {self.limit_mm:g} mm about {self.date}, or as early as {self.earliest}."
        )


def charts_of(revolute: Sequence[bool], records: Sequence[Record]) -> tuple[Chart, ...]:
    """Chart the zeros of all joints and the error.

    Args:
        revolute: per joint of the robot, whether it turns.
        records: by their dates.
    """
    count = len(revolute) + 1
    charts = []
    for joint in range(len(revolute)):
        values, covariance = _joint_values(records, joint)
        unit, factor = SHOWN_UNITS["rad" if revolute[joint] else "m"]
        scores = innovations(values, covariance)
        deviations = covariance.diagonal().sqrt() * factor
        charts.append(
            Chart(f"joint {joint + 1}", unit, values * factor, deviations, scores, limits_of(count))
        )
    rms, scores, spread = (
        torch.tensor([of(one) for one in records], dtype=torch.float64)
        for of in (lambda one: one.session.rms * 1e3, _error_score, _log_spread)
    )
    charts.append(Chart("error", "mm", rms, rms * spread, scores, limits_of(count, True), one_sided=True))
    return tuple(charts)


def trends_of(revolute: Sequence[bool], records: Sequence[Record]) -> tuple[Trend, ...]:
    """Estimate how the zeros of the joints change with time, and with temperature where the sessions state it.

    Where a zero jumped, or was off in single sessions, its drift is estimated beside that.

    Args:
        revolute: per joint of the robot, whether it turns.
        records: by their dates.
    """
    if len(torch.unique(months_of(records))) < FEWEST:
        return ()
    overs, trends = _overs(records), list[Trend]()
    for joint in range(len(revolute)):
        zero = _Zero.of(records, joint, overs)
        if zero is None or len(zero.sessions) <= zero.columns.shape[1] + len(zero.events):
            continue
        unit, factor = SHOWN_UNITS["rad" if revolute[joint] else "m"]
        slopes, deviations = zero.fit(drifts=True)
        trends += [
            Trend(f"joint {joint + 1}", over, unit, slope * factor, deviation * factor)
            for (over, _), slope, deviation in zip(overs, slopes[1:], deviations[1:], strict=False)
        ]
    return tuple(trends)


def jumps_of(revolute: Sequence[bool], records: Sequence[Record]) -> tuple[Jump, ...]:
    """Find between which sessions the zeros of joints jumped, where that explains them better than a drift.

    Args:
        revolute: per joint of the robot, whether it turns.
        records: by their dates.
    """
    if len(torch.unique(months_of(records))) < FEWEST:
        return ()
    overs, jumps = _overs(records), list[Jump]()
    for joint in range(len(revolute)):
        zero = _Zero.of(records, joint, overs)
        if zero is None or not zero.events:
            continue
        unit, factor = SHOWN_UNITS["rad" if revolute[joint] else "m"]
        sizes, deviations = (those[-len(zero.events) :] for those in zero.fit(zero.drifts))
        for event, size, deviation in sorted(
            zip(zero.events, sizes, deviations, strict=True), key=lambda one: one[0].number
        ):
            if abs(size) > CLEAR * deviation:
                before, after = (
                    records[zero.sessions[number]].date for number in (event.number - 1, event.number)
                )
                what, sizes_of = f"joint {joint + 1}", (size * factor, deviation * factor)
                jumps.append(Jump(what, unit, *sizes_of, before, after, event.alone))
    return tuple(jumps)


def _overs(records: Sequence[Record]) -> list[tuple[Literal["month", "kelvin"], Tensor]]:
    """What zeros may change with: time and, where the sessions state various ones, temperature."""
    temperature = torch.tensor(
        [math.nan if one.temperature_c is None else one.temperature_c for one in records], dtype=torch.float64
    )
    overs: list[tuple[Literal["month", "kelvin"], Tensor]] = [("month", months_of(records))]
    if bool(torch.isfinite(temperature).all()) and float(temperature.std()) >= FEWEST_KELVINS:
        overs.append(("kelvin", temperature))
    return overs


@dataclass(frozen=True, eq=False)
class _Zero:
    """The zero of a joint over the sessions that show it.

    Attributes:
        series: its shifts [rad or m].
        sessions: numbers of these sessions.
        columns: 1, months and, where they vary, temperatures about their means.
        events: jumps, and sessions that are off.
        drifts: whether time explains more beside these.
    """

    series: Series
    sessions: list[int]
    columns: Float64[Tensor, "values columns"]
    events: tuple[Event, ...]
    drifts: bool

    @staticmethod
    def of(records: Sequence[Record], joint: int, overs: Sequence[tuple[str, Tensor]]) -> "_Zero | None":
        """Find its changes; None where too few sessions show it."""
        values, covariance = _joint_values(records, joint)
        there = torch.isfinite(values).nonzero()[:, 0]
        if len(there) < FEWEST + len(overs) - 1:
            return None
        columns = [torch.ones(len(records), dtype=torch.float64), *(over - over.mean() for _, over in overs)]
        A = torch.stack(columns, 1)[there]
        series = Series(values[there], covariance[there[:, None], there])
        months = torch.arange(A.shape[1]) == 1
        events, drifts = series.events(A[:, ~months], A[:, months])
        return _Zero(series, there.tolist(), A, events, drifts)

    def fit(self, drifts: bool) -> tuple[list[float], list[float]]:
        """Coefficients and their standard deviations, those of the events last."""
        columns = self.columns if drifts else self.columns[:, torch.arange(self.columns.shape[1]) != 1]
        return self.series.fit(self.series.with_events(columns, self.events))


def forecast_of(records: Sequence[Record], limit_mm: float) -> Forecast:
    """Forecast when the RMS error of a session passes a limit, by a straight line through those of all sessions."""
    months, last = months_of(records), records[-1]
    rms = torch.tensor([one.session.rms * 1e3 for one in records], dtype=torch.float64)
    passed = bool(rms[-1] > limit_mm)
    date = earliest = None
    if not passed and bool((rms > 0).all()) and len(torch.unique(months)) >= FEWEST:
        spread = rms * torch.tensor([math.sqrt(0.5 / one.session.values) for one in records]).double()
        usual = rms * torch.tensor([_log_spread(one) for one in records]).double()
        columns = torch.stack([torch.ones_like(months), months - months[-1]], 1)
        events, _ = Series(rms, usual.square().diag()).events(columns[:, :1], columns[:, 1:])
        series = Series(rms, spread.square().diag())
        columns = series.with_events(columns, events)
        coefficients, deviations = series.fit(columns)
        slope, deviation = coefficients[1], deviations[1]
        now = float((columns[-1] * torch.tensor(coefficients)).sum())
        left = ((rms - columns @ torch.tensor(coefficients).double()) / spread).square().sum()
        spare = max(len(rms) - columns.shape[1], 1)
        deviation *= max(1.0, math.sqrt(float(left) / spare))  # sessions scatter by more than few rows do
        if slope > NORMAL_95 * deviation:
            date = _after(last.date, (limit_mm - now) / slope)
            earliest = _after(last.date, (limit_mm - now) / (slope + NORMAL_95 * deviation))
    return Forecast(limit_mm, passed, date, earliest if date else None)


def months_of(records: Sequence[Record]) -> Float64[Tensor, " sessions"]:
    """Months since the first session."""
    days = [datetime.date.fromisoformat(one.date).toordinal() for one in records]
    return (torch.tensor(days, dtype=torch.float64) - days[0]) / DAYS_PER_MONTH


def _joint_values(records: Sequence[Record], joint: int) -> tuple[Tensor, Tensor]:
    """Shifts of a joint's zero in all sessions [rad or m], NaN where unobservable, and their covariance.

    Sessions have the model's uncertainty in common, so that their shifts err together.
    """
    values = [float(one.zeros.shift[joint]) if one.session.observable[joint] else math.nan for one in records]
    influence = torch.stack([one.zeros.influence[joint] for one in records])
    own = torch.stack([one.zeros.own[joint, joint] for one in records])
    return torch.tensor(values, dtype=torch.float64), influence @ influence.t() + own.diag()


def _error_score(record: Record) -> float:
    """Logarithm of the errors over what was expected, over its standard deviation."""
    return math.log(max(record.session.error_score, 1e-9)) / _log_spread(record)


def _log_spread(record: Record) -> float:
    """Standard deviation of the logarithm of a session's error: that of its noise, and of its few values."""
    return math.sqrt(NOISE_SPREAD**2 + 0.5 / record.session.values)


def _after(date: str, months: float) -> str | None:
    """The day some months after another; None beyond what is forecast."""
    if months > MOST_MONTHS:
        return None
    days = datetime.timedelta(days=max(months, 0.0) * DAYS_PER_MONTH)
    return (datetime.date.fromisoformat(date) + days).isoformat()
