"""Sessions over months: charts of joints and errors, drift with time and temperature, forecast for a limit."""

import datetime
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from pisigma.estimation.drift import NOISE_SPREAD
from pisigma.lifetime.monitoring.charts import Chart, Series, SeriesChange, innovations, limits_of
from pisigma.lifetime.monitoring.history import Record
from pisigma.lifetime.recalibration.movement import CLEAR, NORMAL_95
from pisigma.measurement.sensors.sensor import SHOWN_UNITS, ShownUnit
from pisigma.robot.row import Row

_DAYS_PER_MONTH = 365.25 / 12
"""Mean length of a month [days]."""
_MIN_SESSIONS = 4
"""Smallest number of sessions on different days from which a drift is estimated."""
_MIN_TEMPERATURE_SPREAD = 3.0
"""Standard deviation of the temperatures [K] above which a dependence on temperature is estimated."""
_MAX_MONTHS = 120.0
"""Range of forecasts: ten years."""


@dataclass(frozen=True)
class Trend:
    """Drift of a joint zero with time or temperature.

    Attributes:
        quantity: quantity that drifts, such as "joint 2".
        per: "month" or "kelvin".
        unit: unit of the change per month or kelvin.
        slope: change per month or kelvin [`unit`].
        sigma: standard deviation of the slope [`unit`].
    """

    quantity: str
    per: Literal["month", "kelvin"]
    unit: ShownUnit
    slope: float
    sigma: float

    @property
    def is_significant(self) -> bool:
        """Whether the drift is significant."""
        return abs(self.slope) > CLEAR * self.sigma

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the slope."""
        half = NORMAL_95 * self.sigma
        return self.slope - half, self.slope + half

    @property
    def sentence(self) -> str:
        """Sentence that states the drift."""
        half = NORMAL_95 * self.sigma
        return f"{self.quantity} drifts by {self.slope:.4f} ± {half:.4f} {self.unit} per {self.per}"

    def to_json(self) -> dict[str, Any]:
        """Return slope and interval as plain values."""
        slope = {f"{self.unit}_per_{self.per}": self.slope}
        return {
            "what": self.quantity,
            **slope,
            "interval": list(self.interval),
            "is_significant": self.is_significant,
        }


@dataclass(frozen=True)
class Jump:
    """Jump of a joint zero between two sessions, as after a collision, or deviation in a single session.

    Attributes:
        quantity: quantity that jumped, such as "joint 2".
        unit: unit of the jump.
        size: size of the jump [`unit`].
        sigma: standard deviation of the size [`unit`].
        before: date of the last session before the jump.
        after: date of the first session after the jump.
        has_reverted: whether the zero returned in the next session, so that only the session `after` deviates.
    """

    quantity: str
    unit: ShownUnit
    size: float
    sigma: float
    before: str
    after: str
    has_reverted: bool = False

    @property
    def sentence(self) -> str:
        """Sentence that states the change."""
        half = NORMAL_95 * self.sigma
        if self.has_reverted:
            return (
                f"{self.quantity} deviated by {self.size:.4f} ± {half:.4f} {self.unit} on {self.after} only"
            )
        change = f"{self.size:.4f} ± {half:.4f} {self.unit}"
        return f"{self.quantity} jumped by {change} between {self.before} and {self.after}"

    def to_json(self) -> dict[str, Any]:
        """Return the jump and the dates around it as plain values."""
        return {
            "what": self.quantity,
            f"size_{self.unit}": self.size,
            f"deviation_{self.unit}": self.sigma,
            "before": self.before,
            "after": self.after,
            "has_reverted": self.has_reverted,
        }


@dataclass(frozen=True)
class Forecast:
    """Forecast of the date on which the RMS error passes a limit.

    Attributes:
        limit_mm: the limit [mm].
        limit_exceeded: whether the error of the last session is above the limit.
        date: date on which the trend reaches the limit; None if it does not do so within ten years.
        earliest: start of the 95 % confidence interval of the date; None if this is more than ten years away.
    """

    limit_mm: float
    limit_exceeded: bool
    date: str | None
    earliest: str | None

    @property
    def sentence(self) -> str:
        """Sentence that states the forecast."""
        if self.limit_exceeded:
            return f"The RMS error of the last session is above the limit of {self.limit_mm:g} mm."
        if self.date is None:
            return f"No significant trend leads to an RMS error above {self.limit_mm:g} mm within ten years."
        return (
            f"The RMS error will exceed {self.limit_mm:g} mm around {self.date}, possibly as early as "
            f"{self.earliest}."
        )


def charts_of(joints: Sequence[Row], records: Sequence[Record]) -> tuple[Chart, ...]:
    """Return control charts of all joint zeros and of the error.

    Args:
        joints: joints of the robot; their zeros count in the positive direction of the joint.
        records: sessions sorted by date.
    """
    count = len(joints) + 1
    charts = []
    for number, joint in enumerate(joints, 1):
        values, covariance = _joint_values(records, number - 1, joint.direction)
        unit, factor = SHOWN_UNITS["rad" if joint.type == "revolute" else "m"]
        scores = innovations(values, covariance)
        deviations = covariance.diagonal().sqrt() * factor
        charts.append(Chart(f"joint {number}", unit, values * factor, deviations, scores, limits_of(count)))
    rms, scores, spread = (
        torch.tensor([of(one) for one in records], dtype=torch.float64)
        for of in (lambda one: one.session.rms * 1e3, _error_score, _log_spread)
    )
    charts.append(Chart("error", "mm", rms, rms * spread, scores, limits_of(count, True), one_sided=True))
    return tuple(charts)


def trends_of(joints: Sequence[Row], records: Sequence[Record]) -> tuple[Trend, ...]:
    """Estimate the drift of joint zeros with time, and with temperature if the sessions state it.

    Jumps and single deviating sessions are fitted together with the drift.

    Args:
        joints: joints of the robot; their zeros count in the positive direction of the joint.
        records: sessions sorted by date.
    """
    if len(torch.unique(months_of(records))) < _MIN_SESSIONS:
        return ()
    overs, trends = _overs(records), list[Trend]()
    for number, joint in enumerate(joints, 1):
        zero = _Zero.from_records(records, number - 1, joint.direction, overs)
        if zero is None or len(zero.sessions) <= zero.columns.shape[1] + len(zero.events):
            continue
        unit, factor = SHOWN_UNITS["rad" if joint.type == "revolute" else "m"]
        slopes, deviations = zero.fit(drifts=True)
        trends += [
            Trend(f"joint {number}", over, unit, slope * factor, deviation * factor)
            for (over, _), slope, deviation in zip(overs, slopes[1:], deviations[1:], strict=False)
        ]
    return tuple(trends)


def jumps_of(joints: Sequence[Row], records: Sequence[Record]) -> tuple[Jump, ...]:
    """Find jumps of joint zeros between sessions, where jumps explain the zeros better than a drift.

    Args:
        joints: joints of the robot; their zeros count in the positive direction of the joint.
        records: sessions sorted by date.
    """
    if len(torch.unique(months_of(records))) < _MIN_SESSIONS:
        return ()
    overs, jumps = _overs(records), list[Jump]()
    for number, joint in enumerate(joints, 1):
        zero = _Zero.from_records(records, number - 1, joint.direction, overs)
        if zero is None or not zero.events:
            continue
        unit, factor = SHOWN_UNITS["rad" if joint.type == "revolute" else "m"]
        sizes, deviations = (those[-len(zero.events) :] for those in zero.fit(zero.drifts))
        for event, size, deviation in sorted(
            zip(zero.events, sizes, deviations, strict=True), key=lambda one: one[0].first_index
        ):
            if abs(size) > CLEAR * deviation:
                before, after = (
                    records[zero.sessions[number]].date
                    for number in (event.first_index - 1, event.first_index)
                )
                what, sizes_of = f"joint {number}", (size * factor, deviation * factor)
                jumps.append(Jump(what, unit, *sizes_of, before, after, event.is_single_value))
    return tuple(jumps)


def _overs(records: Sequence[Record]) -> list[tuple[Literal["month", "kelvin"], Tensor]]:
    """Return the quantities with which zeros may drift: time and, if it varies, temperature."""
    temperature = torch.tensor(
        [math.nan if one.temperature_c is None else one.temperature_c for one in records], dtype=torch.float64
    )
    overs: list[tuple[Literal["month", "kelvin"], Tensor]] = [("month", months_of(records))]
    if bool(torch.isfinite(temperature).all()) and float(temperature.std()) >= _MIN_TEMPERATURE_SPREAD:
        overs.append(("kelvin", temperature))
    return overs


@dataclass(frozen=True, eq=False)
class _Zero:
    """Zero of a joint over the sessions that determine it.

    Attributes:
        series: its shifts [rad or m].
        sessions: indices of these sessions.
        columns: columns of the regression: 1, months and, if they vary, temperatures minus their means.
        events: jumps, and single deviating sessions.
        drifts: whether there is also a drift with time.
    """

    series: Series
    sessions: list[int]
    columns: Float64[Tensor, "values columns"]
    events: tuple[SeriesChange, ...]
    drifts: bool

    @staticmethod
    def from_records(
        records: Sequence[Record], joint: int, direction: int, overs: Sequence[tuple[str, Tensor]]
    ) -> "_Zero | None":
        """Find the changes of a joint zero; None if too few sessions determine it."""
        values, covariance = _joint_values(records, joint, direction)
        there = torch.isfinite(values).nonzero()[:, 0]
        if len(there) < _MIN_SESSIONS + len(overs) - 1:
            return None
        columns = [torch.ones(len(records), dtype=torch.float64), *(over - over.mean() for _, over in overs)]
        A = torch.stack(columns, 1)[there]
        series = Series(values[there], covariance[there[:, None], there])
        months = torch.arange(A.shape[1]) == 1
        events, drifts = series.events(A[:, ~months], A[:, months])
        return _Zero(series, there.tolist(), A, events, drifts)

    def fit(self, drifts: bool) -> tuple[list[float], list[float]]:
        """Return fitted coefficients and their standard deviations; coefficients of events come last."""
        columns = self.columns if drifts else self.columns[:, torch.arange(self.columns.shape[1]) != 1]
        return self.series.fit(self.series.with_events(columns, self.events))


def forecast_of(records: Sequence[Record], limit_mm: float) -> Forecast:
    """Forecast when the RMS error of a session exceeds a limit, from a straight line through all sessions."""
    months, last = months_of(records), records[-1]
    rms = torch.tensor([one.session.rms * 1e3 for one in records], dtype=torch.float64)
    exceeded = bool(rms[-1] > limit_mm)
    date = earliest = None
    if not exceeded and bool((rms > 0).all()) and len(torch.unique(months)) >= _MIN_SESSIONS:
        # The RMS of n values has a relative standard deviation of sqrt(1 / 2n).
        spread = rms * torch.tensor([math.sqrt(0.5 / one.session.values) for one in records]).double()
        # A jump must exceed the usual noise between sessions; the fit of the line below estimates this scatter.
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
        deviation *= max(
            1.0, math.sqrt(float(left) / spare)
        )  # sessions scatter more than their few rows explain
        # Without a significant rise there is no date; the earliest date has the largest slope of the 95 % interval.
        if slope > NORMAL_95 * deviation:
            date = _after(last.date, (limit_mm - now) / slope)
            earliest = _after(last.date, (limit_mm - now) / (slope + NORMAL_95 * deviation))
    return Forecast(limit_mm, exceeded, date, earliest if date else None)


def months_of(records: Sequence[Record]) -> Float64[Tensor, " sessions"]:
    """Compute the time of every session since the first one [months]."""
    days = [datetime.date.fromisoformat(one.date).toordinal() for one in records]
    return (torch.tensor(days, dtype=torch.float64) - days[0]) / _DAYS_PER_MONTH


def _joint_values(records: Sequence[Record], joint: int, direction: int) -> tuple[Tensor, Tensor]:
    """Return the shifts of a joint zero in all sessions [rad or m], NaN where unobservable, and their covariance.

    Records contain changes of theta or d, which increase against a joint with the direction -1.

    The shifts are correlated, because all sessions share the uncertainty of the model.
    """
    values = [
        float(one.zeros.shift[joint]) if one.session.zero_is_observable[joint] else math.nan
        for one in records
    ]
    sensitivity = torch.stack([one.zeros.model_sensitivity[joint] for one in records])
    variance = torch.stack([one.zeros.session_covariance[joint, joint] for one in records])
    return direction * torch.tensor(
        values, dtype=torch.float64
    ), sensitivity @ sensitivity.t() + variance.diag()


def _error_score(record: Record) -> float:
    """Compute the logarithm of the ratio of errors to expected errors, divided by its standard deviation."""
    return math.log(max(record.session.error_score, 1e-9)) / _log_spread(record)


def _log_spread(record: Record) -> float:
    """Compute the standard deviation of the logarithm of a session's error, from its noise and its number of values."""
    return math.sqrt(NOISE_SPREAD**2 + 0.5 / record.session.values)


def _after(date: str, months: float) -> str | None:
    """Return the date that is some months after another; None beyond the range of forecasts."""
    if months > _MAX_MONTHS:
        return None
    days = datetime.timedelta(days=max(months, 0.0) * _DAYS_PER_MONTH)
    return (datetime.date.fromisoformat(date) + days).isoformat()
